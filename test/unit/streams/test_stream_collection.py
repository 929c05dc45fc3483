# SPDX-License-Identifier: Apache-2.0
"""The streams of a launch, and streams that contradict each other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest

pytest.importorskip('launch', reason='rclpy is not installed')
from launch import LaunchContext
from launch.substitutions import LaunchConfiguration

from fogros2 import StreamTopic
from fogros2.errors import ConfigurationError
from fogros2.model import MachineSpec, NodeSpec
from fogros2_features.streams import collection
from fogros2_features.streams.part import Part


def test_nodes_are_handed_out_once() -> None:
    streams = collection.Streams()
    names = [(machine, spec.name) for machine, spec in streams.add([('/camera', 'h264')], 'a')]
    assert names == [(None, 'camera_h264_encoder'), ('a', 'camera_h264_decoder')]
    assert streams.add([('/camera', 'h264')], 'a') == []
    assert [(machine, spec.name) for machine, spec in streams.add([('/camera', 'h264')], 'b')] == [
        ('b', 'camera_h264_decoder')]
    assert streams.remappings('b') == {
        '/camera': '/fogros2/b/camera', '/camera_info': '/fogros2/b/camera_info'}
    assert streams.remappings('c') == {}


@pytest.mark.parametrize(('first', 'second', 'machine', 'said'), [
    (('/a', 'h264'), StreamTopic('/a', 'h264', 'to_robot'), 'one', "from 'one' and to it"),
    (('/a', 'h264'), StreamTopic('/a', 'h264', 'to_robot'), 'two', 'from the robot and to it'),
    (StreamTopic('/a', source='two'), StreamTopic('/a', source='one'), 'two',
     "from 'one' and to it"),
    (('/a', 'h264'), ('/a', 'compressed'), 'one', "to 'one' twice"),
    (('/a', 'h264'), StreamTopic('/a', 'h264', bitrate=10_000), 'one', "to 'one' twice"),
    (('/a', 'h264'), StreamTopic('/a', 'h264', bitrate=10_000), 'two', 'different parameters')])
def test_streams_that_contradict_each_other(
    first: Any, second: Any, machine: str, said: str,
) -> None:
    streams = collection.Streams()
    streams.add([first], 'one')
    with pytest.raises(ConfigurationError, match=said):
        streams.add([second], machine)
    # the wrong one isn't there now
    assert len(streams.add([('/b', 'h264')], 'two')) == 2


def test_the_robot_stands_for_a_machine_that_is_taken_away() -> None:
    streams = collection.Streams()
    streams.add([('/a', 'h264'), StreamTopic('/back', 'h264', 'to_robot'),
                 StreamTopic('/map', 'h264', source='other', camera_info=True)], 'gone')
    streams.add([('/a', 'h264'), StreamTopic('/seen', 'h264', source='gone')], 'other')
    before = streams.remappings('other')
    ended, new, left = streams.take_over('gone')
    # /a goes to the other one as before, /map is encoded there as before
    assert ended == ['other/seen_h264_decoder_from_gone', 'robot/back_h264_decoder_from_gone']
    assert sorted((str(machine), spec.id) for machine, spec in new) == [
        ('None', 'robot/map_h264_decoder_from_other'), ('None', 'robot/seen_h264_encoder'),
        ('other', 'other/seen_h264_decoder')]
    assert left == [] and streams.remappings('other') == before
    # of camera info as before, too: the other's nodes have one name for it, and no new one
    words = {spec.id: spec.arguments for _, spec in new}
    assert 'camera_info:=true' in words['robot/map_h264_decoder_from_other']
    assert 'camera_info:=false' in words['other/seen_h264_decoder']
    assert streams.take_over('gone') == ([], [], [])
    # its name has no stream left, so another launch of it would begin anew
    assert streams.remappings('gone') == {}


def test_streams_of_the_description_are_converted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = MachineSpec('a', 'container')
    launched: Any = SimpleNamespace(
        context=LaunchContext(), spec=lambda name: machine, name_of=lambda source: source,
        machines={'a': SimpleNamespace(interrupted=False, sent=[], renamed={})})
    part = Part(launched)
    part.everywhere([('/camera', 'h264')], '')
    assert len(part.beside([], 'a')) == 2
    convert = mock.Mock(wraps=collection.streams.stream)
    monkeypatch.setattr(collection.streams, 'stream', convert)
    assert part.beside([], 'a') == [] and convert.call_count == 0
    # the robot takes the machine's place, and the machine comes back
    part.moved('a')
    assert [program.machine for program in part.beside([], 'a')] == [None]


def test_stream_with_another_transport_is_not_reused() -> None:
    streams = collection.Streams()
    streams.add([StreamTopic('/a', 'h264', source='gone')], 'other')
    streams.add([StreamTopic('/a', 'h264', bitrate=1_000_000)], 'third')
    ended, new, left = streams.take_over('gone')
    assert (ended, new, left) == (['other/a_h264_decoder_from_gone'], [], ['/a'])


def test_entries_are_resolved_when_executed() -> None:
    context = LaunchContext()
    context.launch_configurations.update(topic='camera', rate='1000000', transport='h264')
    entries = [
        (LaunchConfiguration('topic'), LaunchConfiguration('transport')),
        StreamTopic('/b', LaunchConfiguration('transport'),  # type: ignore[arg-type]
                    bitrate=LaunchConfiguration('rate'), lossless=True, preset='fast')]
    collection.check(entries)  # type: ignore[arg-type]
    assert collection.resolve(context, entries, '/arm', lambda _: None) == [  # type: ignore[arg-type]
        StreamTopic('/arm/camera', 'h264'),
        StreamTopic('/b', 'h264', bitrate=1_000_000, lossless=True, preset='fast')]


@pytest.mark.parametrize('text, value', [
    ('1e-3', 0.001), ('5e-06', 5e-06), ('3', 3), ('true', True), ('False', False),
    ('1_000', '1_000'), ('12:30', '12:30'), ('fast', 'fast')])
def test_substituted_parameter_has_the_type_that_rcl_gives(text: str, value: Any) -> None:
    context = LaunchContext()
    context.launch_configurations['p'] = text
    [entry] = collection.resolve(
        context, [StreamTopic('/b', 'h264', p=LaunchConfiguration('p'))], '/', lambda _: None)
    assert (entry.parameters['p'], type(entry.parameters['p'])) == (value, type(value))


@pytest.mark.parametrize('priority', [0, 101, float('nan'), 'high'])
def test_invalid_priority_is_found_at_once(priority: Any) -> None:
    with pytest.raises(ConfigurationError, match='priority'):
        collection.check([StreamTopic('/camera', priority=priority)])


def parameters(node: NodeSpec) -> list[str]:
    return [str(word) for word in node.arguments
            if 'links' in str(word) or 'priority' in str(word)]


def test_decoder_knows_the_links_that_have_a_bandwidth() -> None:
    """The encoder is the same for all machines, so only decoders differ."""
    several = collection.Streams()
    several.bandwidths.update({'m': 10e6, 'n': 5e6, 'other': 0.0})
    found = {(host, node.name): parameters(node) for host, node in [
        *several.add([StreamTopic('/camera', priority=2)], 'm'),
        *several.add([StreamTopic('/map', source='m')], 'n'),
        *several.add([StreamTopic('/camera', priority=2)], 'other'),
        *several.add([StreamTopic('/seen', 'h264', 'to_robot')], 'm')]}
    assert found == {
        (None, 'camera_h264_encoder'): ['priority:=2'],
        ('m', 'camera_h264_decoder'): ['links:="/fogros2/m/link_in=10000000"'],
        ('other', 'camera_h264_decoder'): [],
        ('m', 'map_h264_encoder'): [],
        ('n', 'map_h264_decoder_from_m'): [
            'links:="/fogros2/m/link_out=10000000,/fogros2/n/link_in=5000000"'],
        ('m', 'seen_h264_encoder'): [],
        (None, 'seen_h264_decoder_from_m'): ['links:="/fogros2/m/link_out=10000000"']}
