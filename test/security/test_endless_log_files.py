# SPDX-License-Identifier: Apache-2.0
"""A node that prints without end fills no disk of the robot by launch's log files."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('launch.logging', reason='needs ROS 2, or its embedded default')

import launch.logging

from fogros2.model import MachineSpec
from fogros2.runtime import log_files
from fogros2.runtime.session import Session


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return the folder of launch's log files, with low limits."""
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    monkeypatch.setattr(log_files, 'LIMIT', 100_000)
    monkeypatch.setattr(log_files, 'LOOK', 10_000)
    launch.logging.reset()
    yield tmp_path
    launch.logging.reset()


class Run:
    """A process that launch writes to its log file and to files of the process's own."""

    started, stopping = True, False

    def __init__(self) -> None:
        self.out, _ = launch.logging.get_output_loggers('talker', {'both': {'log', 'own_log'}})

    def on_event(self, event: dict[str, Any]) -> None:
        self.out.info(event['text'])


@pytest.mark.parametrize('event', [
    {'event': 'output', 'node': '1', 'name': 'talker', 'stream': 'stdout'},
    {'event': 'watchdog', 'action': 'none'}])
def test_log_files_stay_within_a_limit(folder: Path, event: dict[str, Any]) -> None:
    session = Session(
        MachineSpec('planner', 'container'), asyncio.new_event_loop(),
        in_thread=None, fail=None, changed=None, preempted=None)  # type: ignore[arg-type]
    session._runs['1'] = Run()  # type: ignore[assignment]
    for number in range(20_000):
        text = f'line {number} ' + 'x' * 100
        session._on_event({**event, 'text': text, 'reason': text})  # type: ignore[arg-type]
    files = [path for path in folder.rglob('*') if path.is_file() and not path.is_symlink()]
    sizes = {path.name: path.stat().st_size for path in files}
    assert all(size < 200_000 for size in sizes.values()), sizes
    newest = [path.read_text() for path in files if path.name == 'launch.log']
    assert 'line 19999 ' in newest[0], 'the newest stays'
