# SPDX-License-Identifier: Apache-2.0
"""Encoder and decoder of point clouds as processes of their own, seen through ROS topics alone."""

from __future__ import annotations

import array
from collections.abc import Callable
import functools
import itertools
from typing import Any

import pytest

pytest.importorskip('zstandard', reason='the extra "point-clouds" is not installed')
pytest.importorskip('rclpy', reason='rclpy is not installed')
import numpy
from sensor_msgs.msg import CompressedImage, PointCloud2, PointField

from fogros2_examples.city import City
from fogros2_examples.lidar import message
from point_cloud_stream.control import COARSEST
from rigs.bench import Bench, BEST_EFFORT, RELIABLE

SCAN = City(16, 256).scan(3)


def cloud(number: int) -> PointCloud2:
    """Return cloud ``number`` of a sequence."""
    made = message(SCAN)
    made.header.frame_id = f'frame {number}'
    made.header.stamp.sec, made.header.stamp.nanosec = 1000 + number, 7 * number
    return made


def source(bench: Bench, topic: str = '/points') -> Callable[[], None]:
    """Return what publishes the next cloud."""
    publisher = bench.node.create_publisher(PointCloud2, topic, RELIABLE)
    count = iter(range(1_000_000))
    return lambda: publisher.publish(cloud(next(count)))


def start(bench: Bench, role: str, *words: str) -> list[str]:
    return bench.start(role, *words, package='point_cloud_stream')


def pair(bench: Bench, *words: str, topic: str = '/points') -> tuple[list[str], list[str]]:
    """Start both, from a topic to the same one below /seen; return what each writes."""
    return (start(bench, 'encoder', '-r', f'points:={topic}', *words),
            start(bench, 'decoder', '-r', f'points:=/seen{topic}', '-p',
                  f'stream:={topic}/pointcloud'))


def points(got: PointCloud2) -> Any:
    return numpy.frombuffer(got.data, SCAN.dtype).reshape(got.height, got.width)


def test_clouds_of_several_streams_come_out_as_they_went_in(bench: Bench) -> None:
    pair(bench)
    encoder, decoder = pair(bench, topic='/rear')
    publish = [source(bench), source(bench, '/rear')]
    seen = bench.heard(PointCloud2, '/seen/points', BEST_EFFORT)
    bench.until(lambda: len(seen) >= 5, 'clouds', meanwhile=lambda: [p() for p in publish])
    # nobody looks at the other stream, so nothing is done for it
    assert bench.node.count_subscribers('/rear/pointcloud') == 0
    rear = bench.heard(PointCloud2, '/seen/rear')
    start(bench, 'decoder', '-r', 'points:=/late', '-p', 'stream:=/points/pointcloud')
    late = bench.heard(PointCloud2, '/late')
    before = len(seen)
    bench.until(lambda: len(rear) >= 5 and len(late) >= 5 and len(seen) >= before + 5, 'clouds',
                meanwhile=lambda: [p() for p in publish])
    numbers = [got.header.stamp.sec for got in seen]
    assert numbers == sorted(numbers)
    errors = []
    for got in (*seen, *late):
        sent = cloud(got.header.stamp.sec - 1000)
        assert got.header == sent.header and got.fields == sent.fields
        assert (got.height, got.width, got.point_step, got.row_step, got.is_bigendian,
                got.is_dense) == (sent.height, sent.width, sent.point_step, sent.row_step,
                                  sent.is_bigendian, sent.is_dense)
        after = points(got)
        for name in SCAN.dtype.names:
            if name in 'xyz':
                assert (numpy.isnan(after[name]) == numpy.isnan(SCAN[name])).all()
                errors.append(numpy.nanmax(abs(after[name].astype(float) - SCAN[name])))
            else:
                assert (after[name] == SCAN[name]).all()
    # a busy computer's encoder may have taken a coarser resolution
    assert min(errors) <= 0.0005 and max(errors) <= COARSEST / 2
    damage_is_one_warning(bench, encoder, decoder)
    # good clouds go on, also when a decoder dies
    process, _, _ = bench.processes.pop()
    process.kill()
    process.wait(60)
    before = len(seen), len(rear)
    bench.until(lambda: len(seen) >= before[0] + 10 and len(rear) > before[1], 'clouds',
                meanwhile=lambda: [p() for p in publish])


def test_limit_of_bytes_can_be_raised(bench: Bench) -> None:
    large = 40_000_000 // 16
    fields = [PointField(name=name, offset=4 * i, datatype=7, count=1)
              for i, name in enumerate('xyz')]
    sent = PointCloud2(height=1, width=large, point_step=16, row_step=16 * large, fields=fields,
                       data=array.array('B', bytes(16 * large)))
    publisher = bench.node.create_publisher(PointCloud2, '/points', RELIABLE)
    limit = 'max_bytes:=64e6'
    encoder = start(bench, 'encoder', '-r', 'points:=/points', '-p', limit)
    decoder = start(bench, 'decoder', '-r', 'points:=/seen/points', '-p',
                    'stream:=/points/pointcloud', '-p', limit)
    seen = bench.heard(PointCloud2, '/seen/points')
    looks = itertools.count()
    bench.until(lambda: seen, f'the cloud: {encoder} {decoder}',
                meanwhile=lambda: next(looks) % 60 or publisher.publish(sent))
    assert len(seen[0].data) == 16 * large


def damage_is_one_warning(bench: Bench, encoder: list[str], decoder: list[str]) -> None:
    """Send coded clouds to the decoder and clouds to the encoder that are damaged."""
    cut = b'\0\1\0\0\1'
    for kind, topic, lines, damaged in (
            (CompressedImage, '/rear/pointcloud', decoder, {
                'no point cloud': CompressedImage(data=array.array('B', bytes(100))),
                'a layout that was cut': CompressedImage(), 'ends too soon': cut}),
            (PointCloud2, '/rear', encoder, {
                'ends too soon': cut, 'not float32': PointCloud2(
                    height=1, width=1, point_step=4, row_step=4,
                    data=array.array('B', bytes(4)))})):
        publisher = bench.node.create_publisher(kind, topic, RELIABLE)
        for text, bad in damaged.items():
            bench.until(lambda text=text, lines=lines: any(text in line for line in lines),
                        'a warning', meanwhile=functools.partial(publisher.publish, bad))


def test_large_clouds_cross_a_link_that_loses_messages(root: None, bench: Bench) -> None:
    """Every fifth datagram is lost; the middleware repeats slices, and none is shown damaged."""
    with bench.lossy():
        pair(bench, '-p', 'lossless:=true')
        seen = bench.heard(PointCloud2, '/seen/points')
        bench.until(lambda: len(seen) >= 3, 'clouds', timeout=60, meanwhile=source(bench))
    assert all(bytes(got.data) == SCAN.tobytes() for got in seen)
