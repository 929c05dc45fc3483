# SPDX-License-Identifier: Apache-2.0
"""What a launch file may say of streams, and what is refused before anything is created."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from fogros2.errors import ConfigurationError, PrerequisiteError
from fogros2_features.streams.entries import nodes, stream, StreamTopic
from fogros2_features.streams.transport import Stream


def test_entries() -> None:
    assert stream(('/camera', 'h264'), 'm') == Stream('/camera', 'h264', target='m')
    assert stream(StreamTopic('/seen', 'h264', 'to_robot', bitrate=1_000_000), 'm') == Stream(
        '/seen', 'h264', source='m', options={'bitrate': 1_000_000})
    assert StreamTopic('/c') == StreamTopic('/c', 'h264', 'to_cloud')
    assert stream(StreamTopic('/map', source='a'), 'b') == Stream(
        '/map', 'h264', source='a', target='b')


@pytest.mark.parametrize(('entry', 'said'), [
    (('/camera', 'h265'), 'there are: compressed, draco, ffmpeg, h264'),
    ('/camera', 'StreamTopic'), (('/camera',), 'StreamTopic'), (('camera', 'h264'), 'full name'),
    (StreamTopic('/camera', direction='to_robot', source='a'), 'leave source= out'),
    (StreamTopic('/camera', source='m'), 'from m to itself'),
    (StreamTopic('/camera', direction='up'), 'direction')])  # type: ignore[arg-type]
def test_what_is_refused(entry: Any, said: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        stream(entry, 'm')
    assert said in f'{caught.value} {caught.value.hint}'


def test_topics_that_look_alike_are_told_apart() -> None:
    streams = [stream(('/left/image', 'h264'), 'a'), stream(('/left_image', 'h264'), 'a')]
    with pytest.raises(ConfigurationError, match='/left/image and /left_image') as caught:
        nodes(streams)
    assert 'remap' in caught.value.hint


def test_one_topic_from_several_machines() -> None:
    """Each has a stream of its own, and nodes with names of their own."""
    back = StreamTopic('/seen', 'h264', 'to_robot')
    found = nodes([stream(back, 'a'), stream(back, 'b')])
    assert [spec.name for spec in found[None]] == [
        'seen_h264_decoder_from_a', 'seen_h264_decoder_from_b']
    words = [word for specs in found.values() for spec in specs for word in spec.arguments]
    assert sorted(word for word in words if 'stream:=' in str(word)) == sorted(
        2 * ['stream:="/fogros2/a/seen/h264"', 'stream:="/fogros2/b/seen/h264"'])
    names = [word for word in words if '__node' in str(word)]
    assert len(set(names)) == 4, names


def test_two_images_of_one_camera_have_one_camera_info() -> None:
    """It would come twice otherwise; another machine, and another camera, has its own."""
    streams = [stream((topic, 'h264'), machine) for topic, machine in (
        ('/camera/image_raw', 'a'), ('/camera/image_rect', 'a'), ('/camera/image_rect', 'b'),
        ('/other/image_raw', 'a'))]

    def told(machine: str) -> list[bool]:
        return ['camera_info:=true' in spec.arguments for spec in nodes(streams)[machine]]

    assert told('a') == [True, False, True]
    assert told('b') == [True]
    # as it is asked for, or not, on the other side
    assert ['camera_info:=true' in spec.arguments for spec in nodes(streams)[None]] == 3 * [True]


def test_missing_module_of_the_robot_is_found_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, 'find_spec', lambda name: (
        None if name == 'av' else find(name)))
    with pytest.raises(PrerequisiteError) as caught:
        stream(('/camera', 'h264'), 'm')
    assert 'pip install' in caught.value.hint
    # between machines, the robot has nothing to do
    assert stream(StreamTopic('/camera', source='a'), 'b')


def test_what_republish_lacks_is_found_at_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    index = tmp_path / 'share/ament_index/resource_index/packages'
    index.mkdir(parents=True)
    for package in ('image_transport', 'theora_image_transport'):
        with pytest.raises(PrerequisiteError, match=f'need the package {package},'):
            stream(('/camera', 'theora'), 'm')
        (index / package).touch()
    assert stream(('/camera', 'theora'), 'm').transport == 'theora'


@pytest.mark.parametrize(('entry', 'said'), [
    (StreamTopic('/camera', bitrat=3),
     "/camera: streams by h264 have no 'bitrat' (did you mean 'bitrate'?)"),
    (StreamTopic('/camera', 'compressed', quality=3),
     "/camera: streams by compressed have no 'quality' (did you mean 'jpeg_quality'?)"),
    (StreamTopic('/camera', 'compressed', xyz=3),
     "/camera: streams by compressed have no 'xyz' "
     '(there are: camera_info, encoding, format, jpeg_quality, priority)')])
def test_an_unknown_parameter_gets_the_nearest_name(entry, said):
    with pytest.raises(ConfigurationError) as error:
        stream(entry, 'm')
    assert str(error.value) == said


def test_parameters_are_those_that_the_nodes_declare():
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    from fogros2_features.streams.nodes import H264, LARGEST
    from fogros2_features.streams.topics import OPTIONS
    from image_transport_h264 import slices
    from image_transport_h264.senders import PARAMETERS
    assert H264.options == OPTIONS | {name for name, _, _ in PARAMETERS}
    assert LARGEST == slices.LARGEST
