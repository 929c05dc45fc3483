# SPDX-License-Identifier: Apache-2.0
"""A launch that records a topic on its machine, and brings the file home."""

from __future__ import annotations

from pathlib import Path
import uuid

import pytest

pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from rigs.launched import launching

pytestmark = [pytest.mark.usefixtures('nothing_left', 'engine')]


def test_recording_is_at_home_when_the_launch_has_ended(
    tmp_path: Path, cloud_network: str,
) -> None:
    name = f'records-{uuid.uuid4().hex[:6]}'
    home = tmp_path / 'home'
    with launching() as start:
        run = start('fogros2_examples', 'talker.recorded.launch.py', f'name:={name}',
                    f'network:={cloud_network}', f'fetch_to:={home}')
        run.wait_for('recording /chatter to ')
        run.said.clear()
        run.wait_for('Publishing', times=8)  # the recorder may find the topic late
        run.interrupt()
        assert run.ended() == 0, run.text
    file, = home.glob(f'{name}-*/recordings/*.mcap')
    with file.open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        words = [message.data for *_, message in reader.iter_decoded_messages()]
    assert len(words) >= 3 and all('Hello World' in word for word in words)
