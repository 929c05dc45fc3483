# SPDX-License-Identifier: Apache-2.0
"""Steps in the terminal."""

from __future__ import annotations

import io
import logging
import os
import pty
import time

import launch.logging
import pytest

from fogros2.clock import ClockOffset
from fogros2.errors import ConfigurationError
from fogros2.report import (
    ClockMeasured,
    Progress,
    Silence,
    StepDone,
    StepFailed,
    StepStarted,
    Warned,
)
from fogros2.runtime import log_files
from fogros2.runtime.console import Console, Screen


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
        console.close()
        assert ('[######.' in stream.getvalue()) == drawn
        assert ('250.0 MB of 1.0 GB' in stream.getvalue()) == drawn
        assert ('2.0 kB' in stream.getvalue()) == drawn
        assert stream.getvalue() == '' or stream.getvalue().endswith('\r\x1b[K')


def test_silence_and_its_end_are_a_line_each(lines):
    console = Console(io.StringIO())
    console(Silence('planner', 4.7))
    console(Silence('planner', 12.3, over=True))
    assert lines == [('WARNING', 'planner: no answer for 5 s (VPN); nodes keep running'),
                     ('INFO', 'planner: answers again, after 12 s')]


def test_warning_has_its_remedy_on_a_line_of_its_own(lines):
    Console(io.StringIO())(Warned('planner', 'it may lack x', "add pip=['x']"))
    assert lines == [('WARNING', "it may lack x\nadd pip=['x']")]


def dead(how):
    """Return a stream to a terminal or pipe that is closed, or that nobody reads."""
    reader, writer = pty.openpty() if how == 'terminal' else os.pipe()
    if how == 'full':
        os.set_blocking(writer, False)
        try:
            while os.write(writer, b'x' * 4096):
                pass
        except BlockingIOError:
            os.set_blocking(writer, True)
    else:
        os.close(reader)
    return os.fdopen(writer, 'w'), reader


@pytest.mark.parametrize('how', ['terminal', 'pipe', 'full'])
def test_dead_screen_neither_fails_nor_blocks(lines, how):
    launch.logging.launch_config.level = logging.INFO
    stream, reader = dead(how)
    begin = time.monotonic()
    console = Console(stream)
    console._live = True
    for number in range(100):
        console(StepStarted('planner', 'sync'))
        console(Progress('planner', 'sync', number, 100))
        console(StepDone('planner', 'sync', 1.0))
    console.close()
    assert time.monotonic() - begin < 5.0
    assert len(lines) == 100
    if how == 'full':
        os.close(reader)  # frees the thread


def test_screen_keeps_the_order_and_what_a_locale_lacks(capfd):
    reader, writer = os.pipe()
    with os.fdopen(writer, 'w', encoding='ascii') as stream:
        screen = Screen(stream)
        for number in range(1000):
            screen.write(f'{number}\n')
        screen.write('±\n')
        assert screen.drain()
    with os.fdopen(reader) as file:
        assert file.read().splitlines() == [*map(str, range(1000)), '\\xb1']


def test_full_disk_of_the_log_is_one_line(lines, capfd, monkeypatch):
    full = open('/dev/full', 'w')
    handler = launch.logging.launch_config.get_log_file_handler()
    monkeypatch.setattr(handler, 'emit', lambda record: logging.StreamHandler.emit(
        handler, record))
    monkeypatch.setattr(handler, 'stream', full)
    log_files.prepare()
    console = Console(io.StringIO())
    for _ in range(3):
        console(StepDone('planner', 'sync', 1.0))
    console.close()
    with pytest.raises(OSError):
        full.close()
    assert [text for level, text in lines if level == 'WARNING'] == [
        "launch's log file can't be written: No space left on device\n"
        'the launch goes on without it']
    assert 'Traceback' not in ''.join(capfd.readouterr())


def test_log_folder_that_cannot_be_made_has_a_remedy(monkeypatch):
    monkeypatch.setenv('ROS_LOG_DIR', '/dev/null/log')
    launch.logging.reset()
    with pytest.raises(ConfigurationError, match='Not a directory .ROS_LOG_DIR names another'):
        log_files.prepare()
