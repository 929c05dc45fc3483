# SPDX-License-Identifier: Apache-2.0
"""Steps in the terminal."""

from __future__ import annotations

import io
import logging
import os
import pty
import re
import threading
import time

import launch.logging
import pytest

from fogros2.clock import ClockOffset
from fogros2.errors import ConfigurationError, DeadlineExceeded
from fogros2.model import Command
from fogros2.process import run
from fogros2.report import (
    ClockMeasured,
    Progress,
    Silence,
    step,
    StepDone,
    StepFailed,
    StepStarted,
    Warned,
)
from fogros2.runtime import log_files
from fogros2.runtime.console import Console, Screen
from fogros2.waiting import cancellable, doing, everything, noted, wait_until


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
    console(ClockMeasured('planner', ClockOffset(0.01, 0.001)))
    console(ClockMeasured('planner', ClockOffset(-1.2, 0.001), warn=True))
    console(Silence('planner', 4.7))
    console(Silence('planner', 12.3, over=True))
    console(Warned('planner', 'it may lack x', "add pip=['x']"))
    assert lines == [
        ('INFO', 'planner: sync ...'),
        ('INFO', 'planner: sync 1.23 s (3 files)'),
        ('INFO', 'robot: VPN interface failed after 0.50 s'),
        ('WARNING', 'robot: VPN repair failed after 0.50 s: no TUN'),
        ('WARNING', "the clock of 'planner' is 1.20 s behind the robot's (± 1.0 ms), so TF "
         'look-ups and stamp matching between the two fail\n'
         'synchronise both clocks: sudo apt-get install chrony'),
        ('WARNING', 'planner: no answer for 5 s (VPN); nodes keep running'),
        ('INFO', 'planner: answers again, after 12 s'),
        ('WARNING', "it may lack x\nadd pip=['x']")]


def test_progress_on_a_terminal_only(monkeypatch):
    launch.logging.launch_config.level = logging.INFO
    for stream, kind, drawn in (
            (io.StringIO(), 'xterm', False), (Terminal(), 'dumb', False),
            (Terminal(), 'xterm', True)):
        monkeypatch.setenv('TERM', kind)
        console = Console(stream)
        console(StepStarted('planner', 'sync'))
        console(Progress('planner', 'sync', 250_000_000, 1_000_000_000))
        console(Progress('planner', 'sync', 2_000, 0))
        console.close()
        assert ('[######.' in stream.getvalue()) == drawn
        assert ('250.0 MB of 1.0 GB' in stream.getvalue()) == drawn
        assert ('2.0 kB' in stream.getvalue()) == drawn
        assert stream.getvalue().endswith('\r\x1b[K') == drawn


def later(console, seconds):
    """Let the console look at its steps as if they had begun earlier."""
    for running in console._running.values():
        running.begin -= seconds
    console._tick()


def test_slow_step_is_told_with_what_it_waits_for(lines):
    console = Console(io.StringIO())
    with step(console, 'planner', 'machine'):
        with noted("waiting for 'planner' to run"), noted('asking the cloud'):
            for _ in range(8):
                later(console, 10.0)
    with step(console, '', 'choices'):
        later(console, 29.0)
        later(console, 2.0)
    with step(console, 'planner', 'workspace'), noted('sending it'):
        console(Progress('planner', 'workspace', 2_000, 9_000))
        later(console, 31.0)
    later(console, 60.0)
    console.close()
    text = [re.sub(r' \d+\.\d\d s', '', line) for _, line in lines]
    assert text == [
        'planner: machine ...',
        "planner: machine: still working after 30 s (waiting for 'planner' to run)",
        "planner: machine: still working after 60 s (waiting for 'planner' to run)",
        'planner: machine', 'robot: choices ...', 'robot: choices: still working after 30 s',
        'robot: choices', 'planner: workspace ...',
        'planner: workspace: still working after 30 s (sending it, 2.0 kB of 9.0 kB)',
        'planner: workspace']


def test_launch_that_was_stopped_says_once_what_it_does(lines):
    console = Console(io.StringIO())
    with step(console, 'planner', 'machine'):
        later(console, 500.0)  # Ctrl-Z and fg
        later(console, 1.0)
    console.close()
    assert [text for _, text in lines][1:-1] == ['planner: machine: still working after 480 s']


def test_running_time_is_on_a_terminal(lines, monkeypatch):
    monkeypatch.setenv('TERM', 'xterm')
    terminal = Terminal()
    console = Console(terminal)
    with step(console, 'planner', 'machine'):
        with step(console, '', 'VPN'):
            later(console, 1.0)
            later(console, 40.0)
        with noted('install sl'):
            later(console, 1.0)
    console.close()
    shown = [text for text in re.split(r'\r\x1b\[K|[^\r\n]*\n', terminal.getvalue()) if text]
    assert shown == [
        'planner: machine', 'planner: machine   robot: VPN',
        'planner: machine 1 s   robot: VPN 1 s', 'planner: machine 41 s   robot: VPN 41 s',
        'planner: machine 41 s', 'planner: machine 42 s (install sl)']
    assert len(lines) == 2, 'starts are shown where there is no terminal'
    before = terminal.getvalue()
    console._tick()
    assert terminal.getvalue() == before, 'it is drawn no more'


def test_what_threads_do_is_noted_and_forgotten():
    assert doing(threading.get_ident()) == ''
    with noted('outer'), noted('inner'):
        assert doing(threading.get_ident()) == 'outer'
        assert 'outer' in everything() and 'inner' not in everything()
        seen = []
        cancellable(lambda: seen.extend(everything()), threading.Event(), what='asking')
        assert seen == ['outer']
    with pytest.raises(DeadlineExceeded):
        wait_until(lambda: seen.append(doing(threading.get_ident())), timeout=0.01, what='it')
    assert 'waiting for it' in seen
    assert cancellable(lambda: doing(threading.get_ident()), None, what='asking') == 'asking'
    run(Command(('sleep', '0.1'), what='sleep'), timeout=5.0)
    assert doing(threading.get_ident()) == ''


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
    assert time.monotonic() - begin < 30.0
    assert len(lines) == 100
    if how == 'full':
        os.close(reader)  # frees the thread


def test_closed_stream_of_an_earlier_test_ends_no_launch(lines, monkeypatch):
    closed = io.StringIO()
    closed.close()
    monkeypatch.setattr(launch.logging.launch_config.get_screen_handler(), 'stream', closed)
    console = Console()
    console(StepDone('planner', 'sync', 1.0))
    console.close()
    assert lines == [('INFO', 'planner: sync 1.00 s')]


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
