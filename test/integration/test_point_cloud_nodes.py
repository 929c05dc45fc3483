# SPDX-License-Identifier: Apache-2.0
"""Encoder and decoder of point clouds as processes of their own, seen through ROS topics alone."""

from __future__ import annotations

import array
from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip('zstandard', reason='the extra "point-clouds" is not installed')
pytest.importorskip('rclpy', reason='rclpy is not installed')
import numpy
from sensor_msgs.msg import CompressedImage, PointCloud2, PointField

from fogros2_examples.city import City
from fogros2_examples.lidar import message
from point_cloud_stream.parts import split
from rigs.bench import Bench, BEST_EFFORT, RELIABLE

SCAN = City(16, 256).scan(3)


def cloud(number: int, scan: Any = SCAN) -> PointCloud2:
    """Return cloud ``number`` of a sequence."""
    made = message(scan)
    made.header.frame_id = f'frame {number}'
    made.header.stamp.sec, made.header.stamp.nanosec = 1000 + number, 7 * number
    return made


def source(bench: Bench, topic: str = '/points', scan: Any = SCAN) -> Callable[[], None]:
    """Return what publishes the next cloud."""
    publisher = bench.node.create_publisher(PointCloud2, topic, RELIABLE)
    count = iter(range(1_000_000))
    return lambda: publisher.publish(cloud(next(count), scan))


def start(bench: Bench, role: str, *words: str) -> list[str]:
    return bench.start(role, *words, package='point_cloud_stream')


def pair(bench: Bench, *words: str, topic: str = '/points') -> None:
    """Start both, from a topic to the same one below /seen."""
    start(bench, 'encoder', '-r', f'points:={topic}', *words)
    start(bench, 'decoder', '-r', f'points:=/seen{topic}', '-p', f'stream:={topic}/pointcloud')


def points(got: PointCloud2) -> Any:
    return numpy.frombuffer(got.data, SCAN.dtype).reshape(got.height, got.width)


@pytest.mark.parametrize(('words', 'rows', 'bound'), [
    ((), 16, 0.0005), (('-p', 'resolution:=0.01'), 16, 0.005), (('-p', 'resolution:=0.01'), 1,
                                                                0.005),
    (('-p', 'lossless:=true'), 16, 0.0)], ids=['default', 'organised', 'unorganised', 'lossless'])
def test_clouds_come_out_as_they_went_in(
    bench: Bench, words: tuple[str, ...], rows: int, bound: float,
) -> None:
    pair(bench, *words)
    seen = bench.heard(PointCloud2, '/seen/points')
    scan = SCAN.reshape(rows, -1)
    bench.until(lambda: len(seen) >= 5, 'a cloud', meanwhile=source(bench, scan=scan))
    for got in seen:
        sent = cloud(got.header.stamp.sec - 1000, scan)
        assert got.header == sent.header and got.fields == sent.fields
        assert (got.height, got.width, got.point_step, got.row_step, got.is_bigendian,
                got.is_dense) == (sent.height, sent.width, sent.point_step, sent.row_step,
                                  sent.is_bigendian, sent.is_dense)
        after = points(got)
        for name in SCAN.dtype.names:
            if name in 'xyz':
                assert (numpy.isnan(after[name]) == numpy.isnan(scan[name])).all()
                error = numpy.nanmax(abs(after[name].astype(float) - scan[name]))
                assert error <= bound, error
            else:
                assert (after[name] == scan[name]).all()


def unusual(name: str) -> PointCloud2:
    """Return a cloud as other drivers publish it."""
    big, count, kind = name.startswith('big endian'), 40, {
        'names': ['x', 'y', 'z'], 'formats': 3 * ['f4'], 'offsets': [0, 4, 8], 'itemsize': 16}
    if 'packed colours' in name:
        kind = {'names': ['x', 'y', 'z', 'rgb'], 'formats': 3 * ['f4'] + ['u4'],
                'offsets': [0, 4, 8, 16], 'itemsize': 32}
    if 'types' in name:
        kind = {'names': [*'abcdefh', *'zyx', 'größe', ''],
                'formats': ['i1', 'u1', 'i2', 'u2', 'i4', 'u4', 'f8', 'f4', 'f4', 'f4', '5f4',
                            'u1'],
                'offsets': [0, 1, 2, 4, 7, 11, 15, 23, 27, 31, 35, 55], 'itemsize': 61}
    layout = numpy.dtype(kind).newbyteorder('>' if big else '<')
    data = numpy.random.default_rng(7).integers(0, 256, count * layout.itemsize, numpy.uint8)
    values = data.view(layout).reshape(5, -1)
    for axis in 'xyz':
        values[axis] = numpy.random.default_rng(ord(axis)).uniform(-40, 40, values.shape)
    if 'NaN' in name:
        values['x'][::2], values['y'][1], values['z'][:, 3] = numpy.nan, -numpy.inf, 1e20
        if 'all' in name:
            for axis in 'xyz':
                values[axis] = numpy.nan
    fields = []
    codes = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}
    for field in layout.names:
        base, offset = layout.fields[field][:2]
        fields.append(PointField(
            name=field, offset=offset, count=int(numpy.prod(base.shape, dtype=int)),
            datatype=7 if field == 'rgb' else codes[base.base.str[1:]]))
    rows, columns = (1, count) if 'row' in name else values.shape
    if 'empty' in name:
        rows, columns = ((0, 0) if 'fields' in name else (1, 0) if 'line' in name else (5, 0))
    if 'fields' in name:
        fields, layout = [], numpy.dtype([])
    if 'count 0' in name:
        for field in fields:
            field.count = 0
    padding = 13 if 'padding' in name else 0
    octets = data[:rows * columns * layout.itemsize].reshape(rows, columns * layout.itemsize)
    octets = numpy.pad(octets, ((0, 0), (0, padding)), constant_values=9)
    return PointCloud2(
        height=rows, width=columns, fields=fields, is_bigendian=big,
        point_step=layout.itemsize, row_step=octets.shape[1], is_dense='NaN' not in name,
        data=array.array('B', octets.tobytes()))


def arrived(bench: Bench, publisher: Any, cloud: PointCloud2, seen: list[Any]) -> PointCloud2:
    """Publish a cloud until it has arrived, and return the cloud that did."""
    def same() -> list[Any]:
        return [each for each in seen if each.header.frame_id == cloud.header.frame_id]

    bench.until(same, cloud.header.frame_id, meanwhile=lambda: publisher.publish(cloud))
    return same()[0]


@pytest.mark.parametrize('lossless', ['true', 'false'])
def test_unusual_clouds_come_out_as_they_went_in(bench: Bench, lossless: str) -> None:
    names = ['packed colours, count 0', 'row, packed colours', 'NaN', 'row, NaN', 'all NaN',
             'types', 'row, types', 'big endian', 'big endian, types, padding', 'padding', 'empty',
             'empty line', 'empty, no rows or fields', 'empty, padding', 'types, NaN, padding']
    pair(bench, '-p', f'lossless:={lossless}')
    seen = bench.heard(PointCloud2, '/seen/points')
    publisher = bench.node.create_publisher(PointCloud2, '/points', RELIABLE)
    for name in names:
        sent = unusual(name)
        sent.header.frame_id = name
        got = arrived(bench, publisher, sent, seen)
        for axis in 'xyz' if lossless == 'false' and sent.data else '':
            before, after = (coordinates(each, axis) for each in (sent, got))
            with numpy.errstate(invalid='ignore'):
                errors = numpy.abs(before.astype(float) - after)
            assert (numpy.isfinite(before) == numpy.isfinite(after)).all(), name
            assert numpy.nanmax(errors, initial=0.0) <= 0.0005, name
            after[:] = before
        assert got == sent, name


def coordinates(cloud: PointCloud2, axis: str) -> Any:
    """Return one coordinate of all points, which shares their memory."""
    offset = next(field.offset for field in cloud.fields if field.name == axis)
    return numpy.ndarray(
        (cloud.height, cloud.width), '>f4' if cloud.is_bigendian else '<f4', cloud.data, offset,
        (cloud.row_step, cloud.point_step))


def test_dropped_fields_are_gone(bench: Bench) -> None:
    pair(bench, '-p', 'drop_fields:=intensity,time')
    seen = bench.heard(PointCloud2, '/seen/points')
    bench.until(lambda: seen, 'a cloud', meanwhile=source(bench))
    assert [field.name for field in seen[0].fields] == ['x', 'y', 'z', 'ring']
    assert (points(seen[0])['ring'] == SCAN['ring']).all()


def test_several_streams_and_late_subscribers(bench: Bench) -> None:
    pair(bench)
    pair(bench, topic='/rear')
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


def test_a_decoder_that_dies_stops_nobody(bench: Bench) -> None:
    pair(bench)
    start(bench, 'decoder', '-r', 'points:=/other', '-p', 'stream:=/points/pointcloud')
    seen, other = (bench.heard(PointCloud2, topic) for topic in ('/seen/points', '/other'))
    publish = source(bench)
    bench.until(lambda: seen and other, 'clouds', meanwhile=publish)
    process, _, _ = bench.processes.pop()
    process.kill()
    process.wait(60)
    before = len(seen)
    bench.until(lambda: len(seen) >= before + 10, 'clouds', meanwhile=publish)


def test_large_clouds_cross_a_link_that_loses_messages(root: None, bench: Bench) -> None:
    """Every fifth datagram is lost; the middleware repeats parts, and none is shown damaged."""
    with bench.lossy():
        pair(bench, '-p', 'lossless:=true')
        seen = bench.heard(PointCloud2, '/seen/points')
        bench.until(lambda: len(seen) >= 3, 'clouds', timeout=60, meanwhile=source(bench))
    assert all(bytes(got.data) == SCAN.tobytes() for got in seen)


def test_damaged_parts_leave_the_decoder_running(bench: Bench) -> None:
    lines = start(bench, 'decoder', '-r', 'points:=/seen/points', '-p', 'stream:=/s')
    seen = bench.heard(PointCloud2, '/seen/points')
    publisher = bench.node.create_publisher(CompressedImage, '/s', RELIABLE)
    bench.until(publisher.get_subscription_count, 'the decoder')

    def put(data: bytes) -> None:
        publisher.publish(CompressedImage(format='pointcloud', data=array.array('B', data)))

    for data in (b'', b'PCP1', bytes(100), *split(b'PCS1' + bytes(500), 1, 1, 1)):
        put(data)
    publisher.publish(b'\0\1\0\0\1')
    bench.until(lambda: any('cloud not shown' in line for line in lines)
                and any('ends too soon' in line for line in lines), 'two warnings')
    start(bench, 'encoder', '-r', 'points:=/points', '-p', 'stream:=/s')
    bench.until(lambda: seen, 'a cloud', meanwhile=source(bench))


def test_a_cloud_without_coordinates_is_one_warning(bench: Bench) -> None:
    lines = start(bench, 'encoder', '-r', 'points:=/points')
    bench.heard(CompressedImage, '/points/pointcloud')
    publisher = bench.node.create_publisher(PointCloud2, '/points', RELIABLE)
    good, bad = source(bench), PointCloud2(height=1, width=1, point_step=4, row_step=4,
                                           data=array.array('B', bytes(4)))
    parts = bench.heard(CompressedImage, '/points/pointcloud')
    bench.until(lambda: any('not float32' in line for line in lines), 'a warning',
                meanwhile=lambda: publisher.publish(bad))
    bench.until(lambda: any('ends too soon' in line for line in lines), 'a warning',
                meanwhile=lambda: publisher.publish(b'\0\1\0\0\1'))
    bench.until(lambda: parts, 'a cloud', meanwhile=good)
    assert parts[0].format == 'pointcloud' and parts[0].header.frame_id.startswith('frame ')
