# SPDX-License-Identifier: Apache-2.0
"""The robot's end of the agent against a scripted one: replies, resuming, giving up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import json
import queue
import socket
import threading
from typing import Any

import pytest

from fogros2.agent_client import AgentClient, Heartbeat
from fogros2.errors import (
    AgentError,
    AuthenticationError,
    Cancelled,
    ConnectError,
    DeadlineExceeded,
)
from fogros2.waiting import wait_until

Answer = Callable[[dict[str, Any]], list[Any]]


class ScriptedStream:
    """An agent that answers with what a function returns; None in it ends the stream."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.lines: queue.Queue[bytes] = queue.Queue()
        self.asked: list[dict[str, Any]] = []

    def write(self, data: bytes) -> None:
        for line in data.splitlines():
            request = json.loads(line)
            self.asked.append(request)
            for message in self.answer(request):
                self.say(message)

    def say(self, message: Any) -> None:
        if message is None:
            self.lines.put(b'')
        elif isinstance(message, bytes):
            self.lines.put(message)
        else:
            self.lines.put(json.dumps(message).encode() + b'\n')

    def readline(self) -> bytes:
        return self.lines.get()

    def close(self) -> None:
        self.lines.put(b'')


class ScriptedShell:
    """Opens the streams it is given, one after the other; an exception is raised instead."""

    def __init__(self, *streams: Any) -> None:
        self.streams = list(streams)
        self.opened: list[Any] = []

    def open(self, command: Any) -> Any:
        self.command = command
        if not self.streams:
            raise ConnectError('no more')
        stream = self.streams.pop(0)
        if isinstance(stream, Exception):
            raise stream
        self.opened.append(stream)
        return stream


def agent(next_seq: int = 1, **status: Any) -> ScriptedStream:
    def answer(request: dict[str, Any]) -> list[Any]:
        return [{'id': request['id'], 'ok': True, 'first': 1, 'next': next_seq, **status}]
    return ScriptedStream(answer)


@pytest.fixture
def make() -> Iterator[Callable[..., AgentClient]]:
    clients: list[AgentClient] = []

    def build(*streams: Any, **more: Any) -> AgentClient:
        shell: Any = ScriptedShell(*streams)
        clients.append(AgentClient(shell, '/run/x', agent_path='/run/x/agent.py', **more))
        return clients[-1]
    yield build
    for client in clients:
        client.close()


def until(probe: Callable[[], Any]) -> None:
    wait_until(lambda: bool(probe()), timeout=10, what='it', longest=0.02)


def test_a_reply_goes_to_its_request(make):
    def answer(request):
        return [b'motd of a login script\n', b'[1]\n', b'[' * 100_000 + b'\n',
                {'id': 999, 'ok': True},
                {'id': request['id'], 'ok': True, 'echo': request}]
    client = make(ScriptedStream(answer))
    assert client.request('status', x=1)['echo'] == {'id': 1, 'command': 'status', 'x': 1}
    assert client._shell.command.argv == (
        'python3', '-IS', '/run/x/agent.py', 'connect', '--directory', '/run/x')


def test_a_silence_before_the_subscription_does_not_stand_for_it(make):
    def answer(request):
        said = {} if request['command'] == 'ping' else {'next': 1}
        return [{'id': request['id'], 'ok': True, **said}]
    stream = ScriptedStream(answer)
    client = make(stream, silence=0.2)
    client.request('configure')
    until(lambda: any(request['command'] == 'ping' for request in stream.asked))
    # answered in order, so the ping's answer has been read
    client.request('configure')
    client.subscribe(lambda event: None)
    assert any(request['command'] == 'log' for request in stream.asked)


def test_a_refusal_carries_its_hint(make):
    client = make(ScriptedStream(lambda request: [
        {'id': request['id'], 'ok': False, 'error': 'no', 'hint': 'do x'}]))
    with pytest.raises(AgentError) as caught:
        client.request('start')
    assert (caught.value.args[0], caught.value.hint) == ('no', 'do x')


def test_no_reply_in_time(make):
    client = make(ScriptedStream(lambda request: []))
    with pytest.raises(DeadlineExceeded, match="didn't answer 'status' within 0.05 s"):
        client.request('status', timeout=0.05)


def test_a_cancelled_launch_waits_for_nothing(make):
    cancel = threading.Event()
    client = make(ScriptedStream(lambda request: [cancel.set()][1:]), cancel=cancel)
    with pytest.raises(Cancelled):
        client.request('status', timeout=60)


def test_events_come_once_and_in_order_over_connections(make):
    first, second = agent(), agent(next_seq=6)
    client = make(first, ConnectError('not yet'), second)
    seen: list[dict[str, Any]] = []
    client.subscribe(seen.append, since=1)
    for seq in (1, 2, 2, 3):
        first.say({'event': 'x', 'seq': seq})
    first.say(None)
    until(lambda: second.asked)
    assert second.asked[0]['from'] == 4
    for seq in (3, 4, 5):
        second.say({'event': 'x', 'seq': seq})
    until(lambda: len(seen) == 7)
    assert [e.get('seq', e.get('state')) for e in seen] == [1, 2, 3, 'lost', 'back', 4, 5]


def test_subscribing_without_a_beginning_shows_what_is_new(make):
    stream = agent(next_seq=40)
    client = make(stream)
    seen: list[dict[str, Any]] = []
    client.subscribe(seen.append)
    until(lambda: len(stream.asked) == 2)
    assert stream.asked[1]['from'] == 40
    stream.say({'event': 'old', 'seq': 39})
    stream.say({'event': 'new', 'seq': 40})
    until(lambda: seen)
    assert [e['seq'] for e in seen] == [40]
    later: list[dict[str, Any]] = []
    client.subscribe(later.append)
    stream.say({'event': 'new', 'seq': 41})
    until(lambda: later)
    assert [e['seq'] for e in later] == [41] and [e['seq'] for e in seen] == [40, 41]


def test_an_agent_with_a_new_log_is_heard_from_its_beginning(make):
    first, second = agent(next_seq=60), agent(next_seq=3)
    client = make(first, second)
    seen: list[dict[str, Any]] = []
    client.subscribe(seen.append, since=1)
    first.say({'event': 'x', 'seq': 59})
    until(lambda: seen)
    first.say(None)
    def logs() -> list[Any]:
        return [request['from'] for request in second.asked if request['command'] == 'log']
    until(lambda: len(logs()) == 2)
    assert logs() == [60, 1]
    second.say({'event': 'y', 'seq': 1})
    until(lambda: seen[-1]['event'] == 'y')


def test_what_rotation_took_away_is_said(make):
    client = make(agent(next_seq=10, lost=4))
    seen: list[dict[str, Any]] = []
    client.subscribe(seen.append, since=1)
    until(lambda: seen)
    assert seen == [{'event': 'gap', 'count': 4}]


def test_requests_are_asked_again_on_the_next_connection_but_for_signals(make):
    mute = ScriptedStream(lambda request: [])
    client = make(mute, agent())
    results: dict[str, Any] = {}

    def ask(command: str) -> None:
        try:
            results[command] = client.request(command)
        except AgentError as error:
            results[command] = error
    threads = [threading.Thread(target=ask, args=(name,)) for name in ('stop', 'signal')]
    for thread in threads:
        thread.start()
    until(lambda: len(mute.asked) == 2)
    mute.say(None)
    for thread in threads:
        thread.join(10)
    assert results['stop']['ok'] is True
    assert 'connection was lost' in str(results['signal'])


def test_a_machine_without_an_agent_is_not_tried_for_ever(make):
    client = make(ScriptedStream(lambda request: [
        {'error': 'no agent serves /run/x', 'kind': 'absent'}, None]), agent())
    with pytest.raises(AgentError, match='no agent serves /run/x'):
        client.request('status')
    with pytest.raises(AgentError, match='no agent serves /run/x'):
        client.request('status')


def test_an_agent_that_is_being_restarted_is_waited_for(make):
    def absent() -> ScriptedStream:
        stream = ScriptedStream(lambda request: [])
        stream.say({'error': 'no agent serves /run/x', 'kind': 'absent'})
        stream.say(None)
        return stream
    first = agent()
    client = make(first, absent(), absent(), agent())
    seen: list[dict[str, Any]] = []
    client.subscribe(seen.append, since=1)
    client.request('status')
    first.say(None)
    until(lambda: len(seen) == 2)
    assert [e['state'] for e in seen] == ['lost', 'back']


def test_an_agent_that_has_gone_is_given_up(make):
    first = agent()
    streams = [ScriptedStream(lambda request: []) for _ in range(50)]
    for stream in streams:
        stream.say({'error': 'no agent serves /run/x', 'kind': 'absent'})
        stream.say(None)
    client = make(first, *streams, restart=0.3)
    seen: list[dict[str, Any]] = []
    client.subscribe(seen.append, since=1)
    client.request('status')
    first.say(None)
    until(lambda: len(seen) == 2)
    assert [e['state'] for e in seen] == ['lost', 'absent']


def test_a_program_that_ends_without_a_word_is_given_up(make):
    streams = [ScriptedStream(lambda request: []) for _ in range(50)]
    for stream in streams:
        stream.say(b'python3: can not open file\n')
        stream.say(None)
    client = make(*streams, restart=0.3)
    with pytest.raises(AgentError, match='without a word'):
        client.request('status')
    assert len(client._shell.opened) < 6


def test_a_machine_that_no_longer_takes_our_key_is_not_tried_for_ever(make):
    first = agent()
    client = make(first, AuthenticationError('key refused'), agent())
    seen: list[dict[str, Any]] = []
    client.subscribe(seen.append, since=1)
    first.say(None)
    until(lambda: len(seen) == 2)
    assert [e['state'] for e in seen] == ['lost', 'absent']
    with pytest.raises(AgentError, match='key refused'):
        client.request('status')


def test_an_unreachable_machine_is_the_callers_to_handle(make):
    with pytest.raises(ConnectError):
        make().request('status')


def test_close_ends_the_thread_and_what_waits(make):
    stream = ScriptedStream(lambda request: [])
    client = make(stream)
    caught: list[Exception] = []

    def ask() -> None:
        try:
            client.request('status')
        except AgentError as error:
            caught.append(error)
    thread = threading.Thread(target=ask)
    thread.start()
    until(lambda: stream.asked)
    client.close()
    thread.join(10)
    assert 'closed' in str(caught[0])
    with pytest.raises(AgentError, match='closed'):
        client.request('status')


def test_a_subscriber_that_asks_is_stopped_before_it_hangs(make):
    stream = agent()
    client = make(stream)
    caught: list[Exception] = []

    def subscriber(event: dict[str, Any]) -> None:
        try:
            client.request('status')
        except RuntimeError as error:
            caught.append(error)
    client.subscribe(subscriber, since=1)
    stream.say({'event': 'x', 'seq': 1})
    until(lambda: caught)
    assert 'subscriber' in str(caught[0])


def test_a_connection_that_falls_silent_is_given_up(make):
    mute = ScriptedStream(lambda request: [
        {'id': request['id'], 'ok': True, 'next': 1}] if request['command'] == 'log' else [])
    second = agent()
    # a busy computer may take a while over a thread's turn
    client = make(mute, second, silence=0.8)
    seen: list[dict[str, Any]] = []
    client.subscribe(seen.append, since=1)
    until(lambda: len(seen) == 2)
    assert 'ping' in [request['command'] for request in mute.asked]
    assert [e['state'] for e in seen] == ['lost', 'back']
    # one that answers is kept
    until(lambda: sum(request['command'] == 'ping' for request in second.asked) > 4)
    assert len(seen) == 2


def test_heartbeats_go_out_and_come_back():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as machine:
        machine.bind(('127.0.0.1', 0))
        machine.settimeout(10)
        heartbeat = Heartbeat('127.0.0.1', machine.getsockname()[1], 'abc', interval=0.05)
        for number in (1, 2, 3):
            data, robot = machine.recvfrom(2048)
            beat = json.loads(data)
            assert (beat['launch'], beat['n']) == ('abc', number)
        assert heartbeat.round_trip is None and heartbeat.age is None
        for nonsense in (b'', b'x', b'[]', b'[' * 2000, b'{"launch": "other", "t": 0}'):
            machine.sendto(nonsense, robot)
        machine.sendto(data, robot)
        until(lambda: heartbeat.round_trip is not None)
        assert heartbeat.round_trip < 5 and heartbeat.age is not None
        heartbeat.close()
        assert not heartbeat._thread.is_alive()


@pytest.mark.parametrize('address', ['127.0.0.1', '255.255.255.255'])
def test_a_network_that_is_down_stops_no_heartbeat(address):
    # a port that answers 'refused', and an address that may not be sent to
    heartbeat = Heartbeat(address, 9, 'abc', interval=0.02)
    heartbeat._thread.join(0.2)
    assert heartbeat._thread.is_alive() and heartbeat.round_trip is None
    heartbeat.close()
