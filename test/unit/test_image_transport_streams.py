# SPDX-License-Identifier: Apache-2.0
"""What a launch file may say of streams, and what is refused before anything is created."""

from __future__ import annotations

from typing import Any

import pytest

from fogros2 import plugin_system
from fogros2.errors import ConfigurationError
from fogros2.image_transport.compressed import Compressed
from fogros2.image_transport.h264 import H264
from fogros2.image_transport.streams import nodes, stream, StreamTopic
from fogros2.model import Stream

PLUGINS: dict[str, Any] = {'h264': H264, 'compressed': Compressed}


@pytest.fixture(autouse=True)
def plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let two transports be installed, whatever this environment has."""
    monkeypatch.setattr(plugin_system, 'names', lambda group: sorted(PLUGINS))
    monkeypatch.setattr(plugin_system, 'load', lambda group, name: PLUGINS[name])


def test_entries() -> None:
    assert stream(('/camera', 'h264'), 'm') == Stream('/camera', 'h264', target='m')
    assert stream(StreamTopic('/seen', 'h264', 'to_robot', bitrate=1_000_000), 'm') == Stream(
        '/seen', 'h264', source='m', options={'bitrate': 1_000_000})
    assert StreamTopic('/c') == StreamTopic('/c', 'h264', 'to_cloud')


@pytest.mark.parametrize(('entry', 'said'), [
    (('/camera', 'h265'), 'there are: compressed, h264'),
    (('/camera', 'vhs'), 'there are: compressed, h264'),
    ('/camera', 'StreamTopic'), (('/camera',), 'StreamTopic'), (('camera', 'h264'), 'full name'),
    (StreamTopic('/camera', direction='up'), 'direction')])  # type: ignore[arg-type]
def test_what_is_refused(entry: Any, said: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        stream(entry, 'm')
    assert said in f'{caught.value} {caught.value.hint}'


def test_nodes_of_several_streams_and_machines() -> None:
    streams = [stream(('/camera', 'h264'), 'a'), stream(('/camera', 'h264'), 'b'),
               stream(StreamTopic('/seen', 'compressed', 'to_robot'), 'a')]
    found = {machine: [spec.name for spec in specs] for machine, specs in nodes(streams).items()}
    assert found == {
        None: ['camera_h264_encoder', 'seen_compressed_decoder'],
        'a': ['camera_h264_decoder', 'seen_compressed_encoder'], 'b': ['camera_h264_decoder']}


def test_one_topic_is_encoded_in_one_way() -> None:
    streams = [stream(('/camera', 'h264'), 'a'),
               stream(StreamTopic('/camera', bitrate=500_000), 'b')]
    with pytest.raises(ConfigurationError, match='twice'):
        nodes(streams)
