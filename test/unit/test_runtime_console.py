# SPDX-License-Identifier: Apache-2.0
"""Steps in the terminal."""

from __future__ import annotations

import io
import logging

import launch.logging
import pytest

from fogros2.clock import ClockOffset
from fogros2.report import (
    ClockMeasured,
    Progress,
    Silence,
    StepDone,
    StepFailed,
    StepStarted,
    Warned,
)
from fogros2.runtime.console import Console


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def lines(monkeypatch, tmp_path):
    """Collect what the logger ``fogros2`` is given."""
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
    records = []

    class Handler(logging.Handler):
        def emit(self, record):
            records.append((record.levelname, record.getMessage()))

    handler = Handler()
    logger = launch.logging.get_logger('fogros2')
    level = launch.logging.launch_config.level
    logger.addHandler(handler)
    yield records
    logger.removeHandler(handler)
    launch.logging.launch_config.level = level
    launch.logging.reset()


def test_lines(lines):
    launch.logging.launch_config.level = logging.DEBUG
    console = Console(io.StringIO())
    console(StepStarted('planner', 'sync'))
    console(StepDone('planner', 'sync', 1.234, '3 files'))
    console(StepFailed('', 'VPN interface', 0.5, 'no TUN'))
    console(StepFailed('', 'VPN repair', 0.5, 'no TUN', fatal=False))
    assert lines == [
        ('DEBUG', 'planner: sync ...'),
        ('INFO', 'planner: sync 1.23 s (3 files)'),
        ('INFO', 'robot: VPN interface failed after 0.50 s'),
        ('WARNING', 'robot: VPN repair failed after 0.50 s: no TUN')]


def test_only_a_large_clock_offset_is_a_warning(lines):
    console = Console(io.StringIO())
    console(ClockMeasured('planner', ClockOffset(0.01, 0.001)))
    console(ClockMeasured('planner', ClockOffset(-1.2, 0.001), warn=True))
    assert lines == [('WARNING', (
        "the clock of 'planner' is 1.20 s behind the robot's (± 1.0 ms), so TF look-ups and stamp "
        'matching between the two fail\nsynchronise both clocks: sudo apt-get install chrony'))]


def test_log_level(lines):
    launch.logging.launch_config.level = logging.WARNING
    console = Console(Terminal())
    console(StepDone('planner', 'sync', 1.0))
    console.close()
    assert lines == []


def test_progress_on_a_terminal_only():
    launch.logging.launch_config.level = logging.INFO
    for stream, drawn in ((io.StringIO(), False), (Terminal(), True)):
        console = Console(stream)
        console(StepStarted('planner', 'sync'))
        console(Progress('planner', 'sync', 250_000_000, 1_000_000_000))
        console(Progress('planner', 'sync', 2_000, 0))
        assert ('[######.' in stream.getvalue()) == drawn
        assert ('250.0 MB of 1.0 GB' in stream.getvalue()) == drawn
        assert ('2.0 kB' in stream.getvalue()) == drawn
        console.close()
        assert stream.getvalue() == '' or stream.getvalue().endswith('\r\x1b[K')


def test_silence_and_its_end_are_a_line_each(lines):
    console = Console(io.StringIO())
    console(Silence('planner', 4.7))
    console(Silence('planner', 0.0))
    assert lines == [('WARNING', 'planner: no answer for 5 s (VPN); nodes keep running'),
                     ('INFO', 'planner: answers again')]


def test_warning_has_its_remedy_on_a_line_of_its_own(lines):
    Console(io.StringIO())(Warned('planner', 'it may lack x', "add pip=['x']"))
    assert lines == [('WARNING', "it may lack x\nadd pip=['x']")]
