# SPDX-License-Identifier: Apache-2.0
"""What a hijacked machine may say, and the robot's launch goes on."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

pytest.importorskip('launch.actions', reason='needs ROS 2, or its embedded default')

from fogros2.actions.session import Session
from fogros2.deploy import RunningMachine
from fogros2.errors import AgentError, ConnectError
from fogros2.model import Endpoint, MachineSpec
from fogros2.shell import lines
from fogros2.shell.ssh import SSHShell


class Endless:
    """A channel on which no line ever ends."""

    closed = False

    def recv(self, size):
        return b'x' * size

    def sendall(self, data):
        raise AssertionError(data)

    def close(self):
        self.closed = True


def test_a_line_without_an_end_fills_no_memory(monkeypatch):
    monkeypatch.setattr(lines, 'MAX_LINE', 1 << 20)
    channel = Endless()
    assert lines.LineStream(channel, 'planner', bytes).readline() == b''
    assert channel.closed


class Told:
    """An agent that says what a test tells it to."""

    silent_for = 0.0

    def subscribe(self, callback, since):
        self.callback, self.since = callback, since


@pytest.mark.parametrize(('error', 'why'), [
    (EOFError(), 'it ended'), (OSError('Socket is closed'), 'Socket is closed')])
def test_a_connection_that_ends_while_a_line_is_written_is_gone(error, why):
    def sendall(data):
        raise error

    stream = lines.LineStream(SimpleNamespace(sendall=sendall), 'planner', bytes)
    with pytest.raises(ConnectError, match=f"the connection to 'planner' is gone: {why}"):
        stream.write(b'line')


def test_command_starts_anew_after_its_connection_was_closed(monkeypatch):
    """By another thread, say; is_alive() still says yes then."""
    transport = SimpleNamespace(is_alive=lambda: True, close=lambda: None)
    started = []

    def channel(fails):
        def exec_command(line):
            if fails:
                raise EOFError
            started.append(line)
        return SimpleNamespace(exec_command=exec_command, get_transport=lambda: transport)

    shell = SSHShell(Endpoint('ssh', '127.0.0.1', 22, 'fog'), name='planner')
    channels = iter([channel(True), channel(False), channel(True), channel(True)])
    monkeypatch.setattr(shell, 'channel', lambda *_: next(channels))
    shell.start('true')
    assert started == ['true']
    with pytest.raises(ConnectError, match='can not start a command'):
        shell.start('true')


def test_that_it_is_gone_is_its_provider_s_to_say():
    job = SimpleNamespace(spec=None, provider=SimpleNamespace(owned=False))
    agent, heard = Told(), []
    machine = RunningMachine(
        SimpleNamespace(ending=False), job, None, None, agent, None,
        SimpleNamespace(address='198.18.7.2'), 7, None, None, None)
    machine.subscribe(heard.append)
    assert agent.since == 7
    for event in ('lost', 'connection', 'gap'):
        agent.callback({'event': event, 'seq': 8, 'state': 'absent', 'reason': 'x', 'count': 1})
    assert heard == []
    agent.callback({'event': 'connection', 'state': 'lost'})
    agent.callback({'event': 'notice', 'seq': 9, 'reason': 'soon'})
    assert [event['event'] for event in heard] == ['connection', 'notice']


@pytest.mark.parametrize('event', [
    {'event': ['started']}, {'event': 'started', 'node': ['n']}, {'event': 'started', 'node': 'n'},
    {'event': 'started', 'node': 'n', 'pid': 1, 'cmd': [1]},
    {'event': 'output', 'node': 'n', 'text': 5}, {'event': 'exited', 'node': 'n'},
    {'event': 'exited', 'node': 'n', 'returncode': 'x'}, {'event': 'refused', 'node': 'n'},
    {'event': 'vpn_repaired', 'seconds': 'x'}, {'event': 'connection', 'state': {}},
    {'event': 'launch_exited', 'returncode': []}])
def test_an_event_that_makes_no_sense_is_left_aside(event):
    heard = []
    loop = asyncio.new_event_loop()
    try:
        session = Session(MachineSpec('planner', 'ssh'), loop, in_thread=None, fail=heard.append,
                          changed=lambda: None, taken_away=lambda session, reason: None)
        session._runs['n'] = SimpleNamespace(on_event=heard.append)
        session._on_event(event)
    finally:
        loop.close()
    assert heard == []


def test_a_machine_that_goes_while_it_is_subscribed_to_is_lost_and_nothing_else():
    heard = []
    job = SimpleNamespace(spec=None, provider=SimpleNamespace(owned=False))

    class Closing(Told):
        def subscribe(self, callback, since):
            machine._gone('it was deleted')
            raise AgentError('the connection to the agent was closed')

        def close(self):
            pass

    machine = RunningMachine(
        SimpleNamespace(ending=False), job, None, None, Closing(), None,
        SimpleNamespace(address='198.18.7.2'), 7, None, None, None)
    machine.subscribe(heard.append)
    assert heard == [{'event': 'lost', 'reason': 'it was deleted'}]
