# SPDX-License-Identifier: Apache-2.0
"""When a machine is idle: the decision by value, and the samples of real processes."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
from pathlib import Path
import pty
import socket
import subprocess
import sys
import time

from hypothesis import given, strategies
from launch import LaunchContext
import pytest

from fogros2 import ContainerInstance
from fogros2.agent import processes
from fogros2.errors import ConfigurationError
from fogros2.model import MachineSpec, NodeSpec
from fogros2.waiting import wait_until
from fogros2_features.guests import program as guests
from fogros2_features.idle import IdleTimeout, program
from fogros2_features.idle.program import (
    carried,
    computed,
    CPU,
    DISCOVERY,
    has_terminal,
    Idle,
    machines,
    MARK,
    marked,
    ready,
    TRAFFIC,
)
from fogros2_testing import FakeRunning

#: What each interval between two samples had: its seconds, the seconds that all nodes computed,
#: bytes in the VPN, and the most seconds that a thread ran or waited for a processor. Recorded of
#: the machines of ``benchmarks/idle.py`` on a busy computer, whose nodes work or wait. Of nodes
#: that wait, the interval of their start is left out.
TRACES = json.loads(Path(__file__).with_name('idle_traces.json').read_text())


def used(timeout: float, rows: list[tuple[float, float, float, bool]]) -> list[bool]:
    """Return the decisions for samples."""
    machine = Idle(timeout)
    return [machine.sample(now, cpu, traffic, {}, connected=connected)
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


@pytest.mark.parametrize('discovery, decisions', [
    (0, [False, False, False]), (4 * DISCOVERY, [False, False, True])])
def test_discovery_of_other_machines_is_no_use(discovery, decisions):
    """Recorded of a node that listens, on one of five machines: announcements every 3 s."""
    machine = Idle(4.0)
    assert [machine.sample(now, 0.13, traffic, {}, connected=False, discovery=discovery)
            for now, traffic in ((0, 149312), (2.05, 174676), (4.18, 199552))] == decisions


def test_other_machines_are_the_peers_but_the_robot(tmp_path, monkeypatch):
    program = tmp_path / 'wg'
    program.write_text('#!/bin/sh\n[ "$*" = "show fog0 peers" ] && printf "robot=\\nfirst=\\n"\n')
    program.chmod(0o755)
    monkeypatch.setenv('PATH', str(tmp_path), prepend=os.pathsep)
    assert machines('fog0') == 1
    assert machines('fog1') == 0
    monkeypatch.setenv('PATH', '/nowhere')
    assert machines('fog0') == 0


@given(strategies.floats(1, 1000), strategies.lists(strategies.tuples(
    strategies.floats(0.1, 60), strategies.floats(0, 0.1), strategies.floats(0, 40_000),
    strategies.booleans()), max_size=60))
def test_decision_is_that_of_the_whole_trace(timeout, steps):
    """It is idle if and only if the last use, by each interval alone, is ``timeout`` ago."""
    machine, now, cpu, traffic = Idle(timeout), 0.0, 0.0, 0.0
    machine.sample(now, cpu, traffic, {}, connected=False)
    last_use = now
    for seconds, share, rate, connected in steps:
        before = now, cpu, traffic
        now, cpu, traffic = now + seconds, cpu + share * seconds, traffic + rate * seconds
        passed = now - before[0]
        if connected or cpu - before[1] >= CPU * passed or traffic - before[2] >= TRAFFIC * passed:
            last_use = now
        assert machine.sample(now, cpu, traffic, {}, connected=connected) == (
            now - last_use >= timeout)


@given(strategies.sampled_from(sorted(TRACES)), strategies.integers(0, 99),
       strategies.floats(3.01, 10))
def test_recorded_machine_ends_only_without_use(name, begin, factor):
    """Whatever the time-out, and wherever in the trace, which repeats, the watch begins."""
    steps = itertools.islice(itertools.cycle(TRACES[name]), begin, begin + 200)
    machine = Idle(factor * max(step[0] for step in TRACES[name]))
    so_far, found = (0.0, 0.0, 0.0, 0.0), []
    for step in [so_far, *steps]:
        so_far = now, cpu, traffic, waited = tuple(a + b for a, b in zip(so_far, step))
        found.append(machine.sample(now, cpu, traffic, {'7': waited}, connected=False))
    assert any(found) is name.startswith('waits')


def test_samples_count_processes_with_the_mark_alone():
    mark = f'idle-{os.getpid()}'
    busy = 'import sys\nwhile True: sum(range(10 ** 5))'
    with subprocess.Popen([sys.executable, '-c', busy], env={**os.environ, MARK: mark}) as process:
        try:
            wait_until(lambda: computed(marked(mark)) > 0.2, timeout=60, what='work')
        finally:
            process.kill()
    assert computed(marked(mark)) == 0.0 == computed([str(process.pid)])
    assert MARK == processes.MARK  # the agent's


def test_thread_that_others_keep_from_the_processor_is_ready():
    mark = f'ready-{os.getpid()}'
    codes = {'works': 'while True: pass', 'waits': 'print(flush=True); input()'}
    with contextlib.ExitStack() as stack:
        threads = {}
        for name, code in codes.items():
            child = stack.enter_context(subprocess.Popen(
                ['nice', '-n', '19', sys.executable, '-c', code], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, env={**os.environ, MARK: mark}))
            stack.callback(child.kill)
            threads[name] = str(child.pid)
        wait_until(lambda: computed([threads['works']]) > 0.0, timeout=60, what='work')
        assert child.stdout is not None and child.stdout.readline() == b'\n'
        # one that still starts would be ready too
        stat = Path('/proc', threads['waits'], 'stat')
        wait_until(lambda: stat.read_text().rpartition(')')[2].split()[0] == 'S', timeout=60,
                   what='the one that waits')
        begin, before = time.monotonic(), ready(marked(mark))
        wait_until(lambda: time.monotonic() - begin > 1.0, timeout=60, what='a second')
        after, passed = ready(marked(mark)), time.monotonic() - begin
    assert after[threads['works']] - before[threads['works']] > program.READY * passed
    assert after[threads['waits']] - before[threads['waits']] < program.READY * passed
    assert ready([threads['works']]) == {}  # it has ended


@pytest.mark.usefixtures('name_of_no_text')
def test_name_of_a_node_may_be_no_text():
    assert computed([str(os.getpid())]) > 0


def test_traffic_is_that_of_the_interface():
    before = carried('lo')
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(('127.0.0.1', 0))
        one.sendto(bytes(1000), one.getsockname())
    assert carried('lo') >= before + 2000
    assert carried('absent') is None


def test_terminal_of_the_user_is_seen():
    user = os.getuid() or 65534  # root's own terminals may be open
    ours, theirs = pty.openpty()
    with subprocess.Popen(
            ['sleep', '60'], stdin=theirs, start_new_session=True, user=user,
            preexec_fn=lambda: __import__('fcntl').ioctl(0, __import__('termios').TIOCSCTTY, 0),
    ) as process:
        try:
            wait_until(lambda: has_terminal(user), timeout=60, what='the terminal')
        finally:
            process.kill()
            os.close(ours)
            os.close(theirs)


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """Return a function that takes a sample, at a time and with seconds that nodes computed."""
    (tmp_path / 'watchdog.json').write_text('["no-such-mark", 1]')

    def look(
        now: float, cpu: float = 0.0, interface: str = 'lo', token: str = 'a', waited: float = 0.0,
    ) -> bool:
        monkeypatch.setattr(program.time, 'monotonic', lambda: now)
        monkeypatch.setattr(program, 'computed', lambda processes: cpu)
        monkeypatch.setattr(program, 'has_terminal', lambda user: False)
        monkeypatch.setattr(program, 'ready', lambda processes: {'7': waited})
        monkeypatch.setattr(program, 'TRAFFIC', 1e12)  # others use the loopback interface
        return program.main(interface, str(tmp_path), 60.0, token, str(tmp_path))

    return look


def test_samples_continue_those_of_former_processes(machine):
    assert [machine(now) for now in (1, 31, 60, 61, 90)] == [False] * 3 + [True] * 2
    assert [machine(now, now) for now in (120, 150)] == [False] * 2  # nodes compute
    assert [machine(now, 150) for now in (180, 209, 210)] == [False, False, True]


def test_starved_node_keeps_the_machine(machine):
    assert [machine(now, waited=0.9 * now) for now in (1, 61, 121)] == [False] * 3
    assert [machine(now, waited=109.0) for now in (151, 180, 181)] == [False, False, True]


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can act as another user')
def test_program_acts_as_the_user_to_see_its_processes():
    with program.acting_as(65534):
        assert (os.geteuid(), os.getegid()) == (65534, 65534)
        status = Path('/proc/self/status').read_text()
        assert int(status.partition('CapEff:')[2].split()[0], 16) == 0  # by the identity alone
    assert (os.geteuid(), os.getegid()) == (0, os.getgid())


def test_new_start_of_nodes_begins_the_time_anew(machine):
    assert [machine(now) for now in (1, 40)] == [False] * 2
    assert [machine(now, token='b') for now in (61, 120, 121)] == [False, False, True]


def test_sample_without_the_vpn_decides_and_leaves_nothing(machine, tmp_path):
    assert not machine(1, interface='absent') and not machine(500, interface='absent')
    assert [path.name for path in tmp_path.iterdir()] == ['watchdog.json']


def test_what_guests_compute_is_use(tmp_path, monkeypatch):
    (tmp_path / 'watchdog.json').write_text('["no-such-mark", 1]')
    assert program.GUESTS == guests.HOMES
    monkeypatch.setattr(program, 'GUESTS', tmp_path / 'guests')
    counted = {'computed': [], 'ready': []}
    monkeypatch.setattr(program, 'computed', lambda pids: counted['computed'].append(pids) or 0.0)
    monkeypatch.setattr(program, 'ready', lambda pids: counted['ready'].append(pids) or {})
    for name in ('other', 'lo'):
        # whose account is this one
        (tmp_path / 'guests' / guests.account(name, '198.18.7.224')).mkdir(parents=True)
        program.main('lo', str(tmp_path), 60.0, 'a', str(tmp_path))
    for pids in counted.values():
        assert [str(os.getpid()) in each for each in pids] == [False, True]


@pytest.mark.parametrize('content', ['', '{}', '[]', '5', None])
def test_machine_whose_nodes_are_unknown_is_not_idle(machine, tmp_path, content):
    path = tmp_path / 'watchdog.json'
    path.unlink() if content is None else path.write_text(content)
    assert not machine(1) and not machine(61)


def test_program_runs_alone_and_says_why(tmp_path):
    """As the agent runs it: isolated, from its source."""
    (tmp_path / 'watchdog.json').write_text('["no-such-mark", 1]')
    source = Path(program.__file__).read_text().replace("'/run'", repr(str(tmp_path)))
    words = (sys.executable, '-IS', '-c', source, 'lo', str(tmp_path), '0.000001', 'token')
    first, second = (subprocess.run(words, capture_output=True, text=True) for _ in range(2))
    assert (first.returncode, first.stdout, first.stderr) == (1, '', '')
    assert second.returncode in (0, 1) and second.stderr == ''
    if second.returncode == 0:
        assert second.stdout == 'nobody has used it for 1e-06 s\n'


@pytest.mark.parametrize(('timeout', 'seconds'), [(5, 2), (60, 6), (600, 30)])
def test_short_timeouts_are_sampled_more_often(timeout, seconds):
    assert program.interval(timeout) == seconds


# -- the feature ---------------------------------------------------------------------------------

def test_each_start_of_nodes_lets_the_time_begin_anew():
    machine, node = FakeRunning(), NodeSpec('a', 'a', arguments=('true',))
    for _ in range(2):
        assert IdleTimeout().starting(machine, [node], 60.0) == [node]
    assert [(name, argv[:3], argv[4:-1], interval) for _, name, argv, interval in machine.calls] \
        == [('idle', ['python3', '-IS', '-c'], ['foga', '/var/lib/agent', '60.0'], 6.0)] * 2
    # not what the machine says
    machine.watches['idle']('\x1b[2J forged')
    assert machine.calls[-1] == ('give_up', 'nobody has used it for 60 s')


@pytest.mark.parametrize('how', [
    {'features': {'containers': {'docker_containers': ['docker run x']}}},
    {'options': {'fleet': ['key']}}])
def test_machine_whose_use_is_unknown_has_no_idle_timeout(how):
    with pytest.raises(ConfigurationError, match='computes|use the machine after'):
        IdleTimeout().check(MachineSpec('a', 'container', **how), 60.0)


def test_machine_of_another_robot_has_no_idle_timeout():
    with pytest.raises(ConfigurationError, match="'a' is a machine of another robot"):
        IdleTimeout().check(MachineSpec('a', 'joined'), 60.0)


@pytest.mark.parametrize('written', [90, '90', '1m30s'])
def test_time_is_a_number_or_a_text(written):
    machine = ContainerInstance(name='a', idle_timeout=written)
    found = machine.spec(LaunchContext()).features['idle']
    assert IdleTimeout.options(**found) == 90.0
