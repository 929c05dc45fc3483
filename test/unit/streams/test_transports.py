# SPDX-License-Identifier: Apache-2.0
"""Transports by value: what nodes a stream becomes, and what its topics are called where."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from fogros2.errors import ConfigurationError
from fogros2.model import to_json
from fogros2_features.streams.entries import remappings, stream, StreamTopic
from fogros2_features.streams.nodes import Compressed, H264, PointCloud, Raw
from fogros2_features.streams.republish import Draco, Theora
from fogros2_features.streams.topics import node
from fogros2_features.streams.transport import Stream
from image_transport_h264.settings import Settings

TO_CLOUD = Stream('/front/image_raw', 'h264', target='planner-1',
                  options={'bitrate': 2_000_000, 'quality': 21.5, 'lossless': False,
                           'preset': 'superfast', 'encoding': 'rgb8'})
FROM_CLOUD = Stream('/annotated', 'h264', source='planner-1')


def words(arguments: tuple[object, ...]) -> dict[str, str]:
    """Return what a command line says, by name."""
    pairs = [str(word) for word in arguments if ':=' in str(word)]
    return dict(pair.split(':=', 1) for pair in pairs)


def test_robot_to_cloud() -> None:
    """The encoder takes the topic's own name, the decoder publishes the machine's."""
    encoder, decoder = H264().encoder(TO_CLOUD), H264().decoder(TO_CLOUD)
    assert (encoder.package, encoder.executable) == ('image_transport_h264', 'encoder')
    assert encoder.arguments[0] == '--ros-args'
    assert words(encoder.arguments) == {
        '__node': 'front_image_raw_h264_encoder', 'image': '/front/image_raw',
        'camera_info': 'true', 'codec': '"h264"',
        'stream': '"/front/image_raw/h264"', 'bitrate': '2000000', 'quality': '21.5',
        'lossless': 'false', 'preset': '"superfast"'}
    assert words(decoder.arguments) == {
        '__node': 'front_image_raw_h264_decoder_on_planner_1',
        'image': '/fogros2/planner_1/front/image_raw',
        'camera_info': 'true', 'codec': '"h264"',
        'stream': '"/front/image_raw/h264"', 'encoding': '"rgb8"'}
    assert encoder.id == 'robot/front_image_raw_h264_encoder'
    assert decoder.id == 'planner-1/front_image_raw_h264_decoder'
    assert to_json(encoder)


@pytest.mark.parametrize('value, text', [
    (1e-05, '1e-05'), (5e-324, '5e-324'), (1e20, '1e+20'), (float('inf'), 'Infinity'),
    (0.1, '0.1'), ('123E5', '"123E5"'), ('a"b', '"a\\"b"')])
def test_option_keeps_its_value_and_type(value: object, text: str) -> None:
    made = node(Stream('/a', 'h264', target='m', options={'quality': value}), role='encoder',
                name='h264', package='p', topic='image', options=(), parameters={})
    assert words(made.arguments)['quality'] == text


@pytest.mark.parametrize(('transport', 'name', 'values'), [
    ('h264', 'bitrate', [5000, 1e10, True, '2M', float('nan')]), ('h264', 'quality', [-1, 52]),
    ('h264', 'gop', [0]), ('h264', 'max_rate', [-1, 1001]), ('h264', 'preset', ['ultra', 1]),
    ('h264', 'encoder', ['x264']), ('h264', 'lossless', ['yes', 2]), ('h264', 'adapt', ['false']),
    ('h264', 'camera_info', ['no']), ('raw', 'priority', [0, 101, 'high']),
    ('compressed', 'jpeg_quality', [0, 101, '80']), ('compressed', 'format', ['webp']),
    ('pointcloud', 'resolution', [-0.1]), ('pointcloud', 'max_rate', ['5']),
    ('pointcloud', 'max_bytes', [0, 1 << 40]), ('pointcloud', 'lossless', ['no'])])
def test_invalid_value_is_found_before_the_node_starts(
    transport: str, name: str, values: list[Any],
) -> None:
    """The node would exit, and be started again, for ever."""
    for value in values:
        with pytest.raises(ConfigurationError, match=f'/camera: {name}='):
            stream(StreamTopic('/camera', transport, **{name: value}), 'm')


def test_accepted_values_are_those_of_the_encoder() -> None:
    for name, limits in H264.numbers.items():
        if name in ('bitrate', 'gop', 'quality'):
            for value in limits:
                Settings(**{name: value})
    for preset, encoder in itertools.product(H264.choices['preset'], H264.choices['encoder']):
        Settings(preset=preset, encoder=encoder)  # type: ignore[arg-type]
    assert stream(StreamTopic('/camera', bitrate=2e6, max_rate=15, quality=28), 'm')


@pytest.mark.parametrize(('options', 'codec'), [
    ({}, 'jpeg'), ({'format': 'png'}, 'png'), ({'jpeg_quality': 60.0}, 'jpeg')])
def test_compressed(options: dict[str, object], codec: str) -> None:
    stream = Stream('/camera', 'compressed', target='m', options=options)
    told = words(Compressed().encoder(stream).arguments)
    assert told['codec'] == f'"{codec}"'
    # a driver's plugin may publish /camera/compressed, which the decoder would hear too
    assert told['stream'] == '"/camera/fogros2/compressed"'
    assert 'format' not in told
    assert told.get('jpeg_quality') == ('60' if 'jpeg_quality' in options else None)


def test_raw_and_republish() -> None:
    stream = Stream('/camera', 'raw', target='m')
    assert words(Raw().decoder(stream).arguments)['stream'] == '"/camera/raw"'
    theora = Stream('/camera', 'theora', target='m', options={
        'quality': 31, 'out.format': 'x', 'camera_info': False})
    encoder, decoder = Theora().encoder(theora), Theora().decoder(theora)
    assert (encoder.package, encoder.executable) == ('image_transport', 'republish')
    assert words(encoder.arguments) == {
        '__node': 'camera_theora_encoder', 'in_transport': 'raw', 'out_transport': 'theora',
        'in': '/camera', 'out/theora': '/camera/fogros2/theora', 'out.theora.quality': '31',
        'out.format': 'x', 'qos_overrides./camera.subscription.reliability': 'best_effort'}
    assert words(decoder.arguments) == {
        '__node': 'camera_theora_decoder_on_m', 'in_transport': 'theora', 'out_transport': 'raw',
        'in/theora': '/camera/fogros2/theora', 'out': '/fogros2/m/camera'}


def test_point_clouds_use_their_own_nodes() -> None:
    points = Stream('/points', 'pointcloud', target='m', options={
        'resolution': 1, 'lossless': False, 'max_rate': 5, 'drop_fields': 'ring,time',
        'max_bytes': 1000})
    encoder, decoder = PointCloud().encoder(points), PointCloud().decoder(points)
    assert (encoder.package, encoder.executable) == ('point_cloud_stream', 'encoder')
    assert words(encoder.arguments) == {
        '__node': 'points_pointcloud_encoder', 'points': '/points',
        'stream': '"/points/pointcloud"', 'resolution': '1', 'lossless': 'false',
        'max_rate': '5', 'drop_fields': '"ring,time"', 'max_bytes': '1000'}
    assert words(decoder.arguments) == {
        '__node': 'points_pointcloud_decoder_on_m', 'points': '/fogros2/m/points',
        'stream': '"/points/pointcloud"', 'max_bytes': '1000'}
    assert remappings([points], 'm') == {
        '/points': '/fogros2/m/points'}


def test_point_clouds_by_republish() -> None:
    stream = Stream('/points', 'draco', target='m', options={'encode_speed': 9})
    encoder, decoder = Draco().encoder(stream), Draco().decoder(stream)
    assert (encoder.package, encoder.executable) == ('point_cloud_transport', 'republish')
    assert words(encoder.arguments)['out/draco'] == '/points/fogros2/draco'
    # as the plugin names it: by the remapped topic
    assert words(encoder.arguments)['points.fogros2.draco.encode_speed'] == '9'
    assert words(decoder.arguments)['out'] == '/fogros2/m/points'


@pytest.mark.parametrize(('topic', 'source'), [
    ('camera', None), ('/camera/', None), ('/1camera', None), ('/', None), ('/camera', 'm')])
def test_stream_that_is_impossible_is_refused(topic: str, source: str | None) -> None:
    with pytest.raises(ConfigurationError):
        stream(StreamTopic(topic, source=source), 'm')


def test_option_that_is_no_parameter_is_refused() -> None:
    with pytest.raises(ConfigurationError, match='bitrate'):
        H264().encoder(Stream('/camera', 'h264', target='m', options={'bitrate': [1, 2]}))


def test_remappings_are_of_the_machines_that_take_part() -> None:
    streams = [TO_CLOUD, FROM_CLOUD, Stream('/other', 'h264', target='elsewhere')]
    assert remappings(streams, None) == {}
    assert remappings(streams, 'planner-1') == {
        '/front/image_raw': '/fogros2/planner_1/front/image_raw',
        '/front/camera_info': '/fogros2/planner_1/front/camera_info',
        '/annotated': '/fogros2/planner_1/annotated'}


def test_camera_info_comes_back_only_when_asked_for() -> None:
    """Or that of an annotated image would take the name of the camera's, and go in a circle."""
    assert words(H264().decoder(FROM_CLOUD).arguments)['camera_info'] == 'false'
    asked = Stream('/left/annotated', 'h264', source='m', options={'camera_info': True})
    assert words(H264().encoder(asked).arguments)['camera_info'] == 'true'
    assert remappings([asked], 'm')['/left/camera_info'] == '/fogros2/m/left/camera_info'
