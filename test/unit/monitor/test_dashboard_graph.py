# SPDX-License-Identifier: Apache-2.0
"""Which topics cross the VPN, how often each is listened to, and pictures made of images."""

from __future__ import annotations

import io
import struct

import pytest

pytest.importorskip('cv2', reason='the extra "video" is not installed')

import cv2
import numpy

from fogros2_features.streams import entries as transports
from fogros2_features.streams.entries import StreamTopic
from fogros2_monitor.dashboard import shots
from fogros2_monitor.dashboard.meter import LARGE, Meter, ROUND
from fogros2_monitor.dashboard.ways import (
    Crossing,
    crossing,
    decoded,
    Hosts,
    OWN,
    Stream,
    streams,
    Topic,
)
from image_transport_h264.picture import BadPicture, Picture

IMAGE, PACKET = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'


def topic(name: str, publishers: str = '', subscribers: str = '',
          kind: str = 'std_msgs/msg/String') -> Topic:
    return Topic(name, kind, frozenset(publishers.split()), frozenset(subscribers.split()))


def node_names(*entries: StreamTopic, machine: str) -> list[str]:
    """Return the names of the nodes that a launch would start."""
    found = transports.nodes([transports.stream(entry, machine) for entry in entries])
    return [word.partition(':=')[2] for specs in found.values() for spec in specs
            for word in spec.arguments if isinstance(word, str) and word.startswith('__node:=')]


def test_streams_are_found_by_node_names() -> None:
    names = node_names(
        StreamTopic('/camera/image_raw', 'h264'), StreamTopic('/annotated', 'h264', 'to_robot'),
        StreamTopic('/map', 'compressed', source='far-away'), machine='slam-1')
    hosts = Hosts({'slam-1': ['slam'], 'far-away': []})
    graph = [
        topic('/camera/image_raw', 'driver', 'camera_image_raw_h264_encoder', IMAGE),
        topic('/camera/image_raw/h264', 'camera_image_raw_h264_encoder',
              f'camera_image_raw_h264_decoder_on_slam_1 {OWN}', PACKET),
        topic('/fogros2/slam_1/annotated/h264', 'annotated_h264_encoder_on_slam_1', OWN, PACKET),
        topic('/annotated', 'annotated_h264_decoder_from_slam_1', OWN, IMAGE),
        topic('/fogros2/far_away/map/fogros2/compressed', 'map_compressed_encoder_on_far_away',
              'map_compressed_decoder_from_far_away_on_slam_1', PACKET)]
    found = streams(graph, names, hosts)
    assert found == [
        Stream('/camera/image_raw', 'h264', '/camera/image_raw/h264', PACKET, '', 'slam-1', True),
        Stream('/map', 'compressed', '/fogros2/far_away/map/fogros2/compressed', PACKET,
               'far-away', 'slam-1', True),
        Stream('/annotated', 'h264', '/fogros2/slam_1/annotated/h264', PACKET, 'slam-1', '',
               False)]
    assert [decoded(one) for one in graph] == [False, False, False, True, False]
    assert crossing(graph, hosts, found) == []


def test_crossing_topics_are_found_by_the_hosts_of_nodes() -> None:
    hosts = Hosts({'planner': ['talker', 'slam']})
    graph = [
        topic('/chatter', 'talker', f'listener {OWN}'),
        topic('/status', 'listener', 'slam talker'),
        topic('/here', 'driver', 'listener'), topic('/there', 'talker', 'slam'),
        topic('/both', 'driver talker', 'listener'), topic('/unheard', 'talker', OWN),
        topic('/rosout', 'talker', 'listener'), topic('/parameter_events', 'talker', 'listener'),
        topic('/a/_hidden', 'talker', 'listener'),
        topic('/fogros2/planner/camera', 'camera_h264_decoder_on_planner', 'unknown', IMAGE),
        topic('/points', 'slam', 'listener', 'sensor_msgs/msg/PointCloud2'),
        topic('/camera/h264/feedback', 'talker', 'listener')]
    streamed = [Stream('/camera', 'h264', '/camera/h264', PACKET, '', 'planner', True)]
    kind = 'std_msgs/msg/String'
    found = crossing(graph, hosts, streamed)
    assert [one.topic for one in found if one.large] == ['/points']
    assert [one for one in found if not one.large] == [
        Crossing('/both', kind, ('', 'planner'), ('',)),
        Crossing('/chatter', kind, ('planner',), ('',)),
        Crossing('/status', kind, ('',), ('planner',))]


@pytest.mark.parametrize(('node', 'host'), [
    ('camera_h264_encoder', ''), ('camera_h264_encoder_on_slam_1', 'slam-1'),
    ('a_h264_decoder_from_slam_1', ''), ('a_h264_decoder_from_far_away_on_slam_1', 'slam-1'),
    ('slam', 'slam-1'), ('unknown', ''), ('camera_h264_encoder_on_stranger', 'stranger')])
def test_host_of_a_node_is_found_by_its_name(node: str, host: str) -> None:
    assert Hosts({'slam-1': ['slam'], 'far-away': []}).of(node) == host


def listen(meter: Meter, begin: float, seconds: float, *, hertz: float, size: int) -> list[bool]:
    """Have messages come while the meter wants them; return whether it did, at each quarter."""
    wanted = []
    for quarter in range(int(4 * seconds)):
        at = begin + quarter / 4
        wanted.append(meter.wants(at))
        if wanted[-1]:
            for number in range(int(hertz / 4)):
                meter.heard(at + number / hertz, size)
    return wanted


def test_small_topic_is_measured_all_the_time() -> None:
    meter = Meter(0.0)
    assert meter.rates() == (None, None)
    assert all(listen(meter, 0.0, 20.0, hertz=8, size=100))
    rate, bandwidth = meter.rates()
    assert rate == pytest.approx(8, rel=0.1) and bandwidth == pytest.approx(800, rel=0.1)
    assert not meter.sampled
    listen(meter, 20.0, 10.0, hertz=0, size=0)
    assert meter.rates() == (0, 0)


def test_large_topic_is_measured_a_second_in_ten() -> None:
    meter = Meter(0.0)
    wanted = listen(meter, 0.0, 40.0, hertz=32, size=10_000)
    assert 0.08 < sum(wanted) / len(wanted) < 0.2
    assert wanted[:4] == [True] * 4 and wanted[6:36] == [False] * 30
    rate, bandwidth = meter.rates()
    assert meter.sampled and rate == pytest.approx(32, rel=0.3)
    assert bandwidth == pytest.approx(320_000, rel=0.3)
    # it has become a small one
    assert all(listen(meter, 40.0 + ROUND, 10.0, hertz=8, size=10)[8:])
    assert not meter.sampled and (meter.rates()[1] or 0) < LARGE


def shown(data: bytes) -> numpy.ndarray:
    pixels = cv2.imdecode(numpy.frombuffer(data, numpy.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    return pixels


@pytest.mark.parametrize(('encoding', 'pixel', 'bgr'), [
    ('rgb8', b'\xff\x00\x00', (0, 0, 255)), ('bgr8', b'\xff\x00\x00', (255, 0, 0)),
    ('rgba8', b'\x00\xff\x00\x80', (0, 255, 0)), ('bgra8', b'\x00\x00\xff\x00', (0, 0, 255)),
    ('mono8', b'\x80', (128, 128, 128)), ('uyvy', b'\x80\x80', (130, 130, 130)),
    ('yuyv', b'\x80\x80', (130, 130, 130))])
@pytest.mark.parametrize('width', [64, 1920])
def test_pictures_keep_their_colours(
    encoding: str, pixel: bytes, bgr: tuple[int, int, int], width: int,
) -> None:
    # rows with something behind them
    row = pixel * width + b'\x07' * 5
    pixels = shown(shots.jpeg(Picture(width, 48, encoding, len(row), row * 48)))
    assert pixels.shape == ((48, 64, 3) if width == 64 else (16, 640, 3))
    assert numpy.abs(pixels.astype(int) - bgr).max() < 12


@pytest.mark.parametrize(('encoding', 'code'), [('16UC1', 'H'), ('32FC1', 'f')])
def test_depth_is_coloured_and_black_where_unknown(encoding: str, code: str) -> None:
    data = io.BytesIO()
    for row in range(48):
        for column in range(64):
            value = 0 if row < 16 else 500 + 100 * column
            data.write(struct.pack(f'<{code}', value))
    step = 64 * struct.calcsize(code)
    pixels = shown(shots.jpeg(Picture(64, 48, encoding, step, data.getvalue())))
    assert pixels[2:12].max() < 40
    near, far = pixels[40, 4].astype(int), pixels[40, 60].astype(int)
    assert near[2] > near[0] and numpy.abs(near - far).sum() > 100
    nothing = shown(shots.jpeg(Picture(64, 48, encoding, step, bytes(48 * step))))
    assert nothing.max() < 10
    if code == 'f':
        nan = struct.pack('<f', float('nan')) * (64 * 48)
        assert shown(shots.jpeg(Picture(64, 48, encoding, step, nan))).max() < 10


@pytest.mark.parametrize('picture', [
    Picture(0, 0, 'rgb8', 0, b''), Picture(4, 4, 'bayer', 4, bytes(16)),
    Picture(4, 4, 'rgb8', 4, bytes(16)), Picture(4, 4, 'rgb8', 12, bytes(7)),
    Picture(1 << 20, 1 << 20, 'mono8', 1 << 20, b'')])
def test_contradictory_image_is_refused(picture: Picture) -> None:
    with pytest.raises(BadPicture):
        shots.jpeg(picture)
