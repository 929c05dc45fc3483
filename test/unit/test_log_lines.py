# SPDX-License-Identifier: Apache-2.0
"""The lines of a machine's log, whose output comes in pieces."""

from __future__ import annotations

import pytest

from fogros2.events import Event
from ros2fog_cli.api import log


def output(text: str, name: str = 'talker-1', stream: str = 'stderr') -> Event:
    return {'event': 'output', 'node': name, 'name': name, 'stream': stream, 'text': text}


def exited(name: str) -> Event:
    return {'event': 'exited', 'node': name, 'name': name, 'returncode': 1, 'respawns': False}


def test_pieces_of_a_line_are_joined_by_node_and_stream() -> None:
    lines = log.Lines()
    assert lines.of(output('[')) == []
    assert lines.of(output('two', 'camera-2')) == []
    assert lines.of(output('out\n', stream='stdout')) == ['out']
    # as rcutils writes: a bracket, then the rest of the line
    assert lines.of(output('INFO] one\n\n[')) == ['[INFO] one', '']
    assert lines.of(output(' lines\r\n', 'camera-2')) == ['two lines']
    assert lines.begun == {('talker-1', 'stderr'): '['}


def test_end_of_a_node_ends_its_last_line() -> None:
    lines = log.Lines()
    lines.of(output('no end'))
    lines.of(output('other', 'camera-2'))
    assert lines.of(exited('talker-1')) == [
        'no end', 'process has finished with exit code 1']
    assert lines.begun == {('camera-2', 'stderr'): 'other'}


def test_line_without_an_end_is_kept_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log, '_KEPT', 10)
    lines = log.Lines()
    assert lines.of(output('12345')) == []
    assert lines.of(output('678901')) == ['12345678901']
    assert lines.begun == {}


def test_event_that_is_not_for_users_has_no_line() -> None:
    assert log.Lines().of({'event': 'connection', 'state': 'absent'}) == []
