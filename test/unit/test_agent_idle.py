# SPDX-License-Identifier: Apache-2.0
"""When a machine is idle: the decision by value, and the samples of real processes."""

from __future__ import annotations

import os
import pty
import socket
import subprocess
import sys

from hypothesis import given, strategies
import pytest

from fogros2.agent.idle import carried, computed, CPU, has_terminal, Idle, IdleWatch, TRAFFIC
from fogros2.agent.loop import Loop
from fogros2.agent.processes import MARK, marked
from fogros2.waiting import wait_until


def used(timeout: float, rows: list[tuple[float, float, float, bool]]) -> list[bool]:
    """Return the decisions for samples."""
    idle = Idle(timeout)
    return [idle.sample(now, cpu, traffic, connected=connected)
            for now, cpu, traffic, connected in rows]


@pytest.mark.parametrize(('rows', 'decisions'), [
    ([(0, 5, 9, False), (5, 5, 9, False), (10, 5, 9, False)], [False, False, True]),
    # below both limits
    ([(0, 0, 0, False), (10, 0.19, 81_000, False)], [False, True]),
    # computes, sends
    ([(0, 0, 0, False), (10, 0.21, 0, False), (19, 0.21, 0, False), (20, 0.21, 0, False)],
     [False, False, False, True]),
    ([(0, 0, 0, False), (10, 0, 82_000, False)], [False, False]),
    # a terminal, until it is closed
    ([(0, 0, 0, False), (10, 0, 0, True), (20, 0, 0, False)], [False, False, True]),
    # a process has ended, or the interface was made anew
    ([(0, 5, 0, False), (10, 4, 0, False), (20, 4, 0, False)], [False, False, True]),
    ([(0, 5, 9, False), (10, 5, 0, False), (20, 5, 0, False)], [False, False, True]),
])
def test_machine_without_use_is_idle_after_its_time(rows, decisions):
    assert used(10.0, rows) == decisions


@given(strategies.floats(1, 1000), strategies.lists(strategies.tuples(
    strategies.floats(0.1, 60), strategies.floats(0, 0.1), strategies.floats(0, 40_000),
    strategies.booleans()), max_size=60))
def test_decision_is_that_of_the_whole_trace(timeout, steps):
    """It is idle if and only if the last use, by each interval alone, is ``timeout`` ago."""
    idle, now, cpu, traffic = Idle(timeout), 0.0, 0.0, 0.0
    idle.sample(now, cpu, traffic, connected=False)
    last_use = now
    for seconds, share, rate, connected in steps:
        before = now, cpu, traffic
        now, cpu, traffic = now + seconds, cpu + share * seconds, traffic + rate * seconds
        passed = now - before[0]
        if connected or cpu - before[1] >= CPU * passed or traffic - before[2] >= TRAFFIC * passed:
            last_use = now
        assert idle.sample(now, cpu, traffic, connected=connected) == (now - last_use >= timeout)


def test_samples_count_processes_with_the_mark_alone():
    mark = f'idle-{os.getpid()}'
    busy = 'import sys\nwhile True: sum(range(10 ** 5))'
    with subprocess.Popen([sys.executable, '-c', busy], env={**os.environ, MARK: mark}) as process:
        try:
            wait_until(lambda: computed(marked(mark)) > 0.2, timeout=20, what='work')
        finally:
            process.kill()
    assert computed(marked(mark)) == 0.0 == computed([process.pid])


def test_traffic_is_that_of_the_interface_with_the_address():
    before = carried('127.0.0.1')
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(('127.0.0.1', 0))
        one.sendto(bytes(1000), one.getsockname())
    assert carried('127.0.0.1') >= before + 2000
    assert carried('198.18.255.1') == 0.0


def test_terminal_of_the_user_is_seen():
    user = os.getuid() or 65534  # root's own terminals may be open
    ours, theirs = pty.openpty()
    with subprocess.Popen(
            ['sleep', '60'], stdin=theirs, start_new_session=True, user=user,
            preexec_fn=lambda: __import__('fcntl').ioctl(0, __import__('termios').TIOCSCTTY, 0),
    ) as process:
        try:
            wait_until(lambda: has_terminal(user), timeout=10, what='the terminal')
        finally:
            process.kill()
            os.close(ours)
            os.close(theirs)


@pytest.mark.parametrize(('share', 'ends'), [(0.0, True), (0.5, False)])
def test_watch_reports_once_when_nobody_uses_the_machine(monkeypatch, share, ends):
    clock = [0.0]
    loop, said = Loop(clock=lambda: clock[0]), []
    monkeypatch.setattr('fogros2.agent.idle.computed', lambda processes: share * clock[0])
    monkeypatch.setattr('fogros2.agent.idle.has_terminal', lambda user: False)
    watch = IdleWatch(loop, os.getuid(), lambda: said.append(clock[0]))
    watch.start(60.0, 'no-such-mark', '')
    while clock[0] < 200:
        clock[0] += 1.0
        loop.turn(0.0)
    assert said == ([60.0] if ends else [])


def test_watch_that_was_stopped_reports_nothing():
    clock = [0.0]
    loop, said = Loop(clock=lambda: clock[0]), []
    watch = IdleWatch(loop, os.getuid(), lambda: said.append(clock[0]))
    watch.start(10.0, 'no-such-mark', '')
    watch.stop()
    clock[0] = 100.0
    loop.turn(0.0)
    watch.start(None, 'no-such-mark', '')
    clock[0] = 200.0
    loop.turn(0.0)
    assert said == []
