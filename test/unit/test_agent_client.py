# SPDX-License-Identifier: Apache-2.0
"""The robot's end of the agent against a scripted one: replies, resuming, giving up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from math import inf, nan
import socket
import threading
import time
from typing import Any

import pytest

from fogros2.agent.protocol import ANSWER, BEAT, sign, verify
from fogros2.agent_client import AgentClient, connection, Heartbeat, interval_for
from fogros2.errors import (
    AgentAbsent,
    AgentError,
    AuthenticationError,
    ConfigurationError,
    ConnectError,
    DeadlineExceeded,
    HostKeyError,
    PrerequisiteError,
    ShellError,
)
from fogros2.waiting import in_thread, wait_until
from rigs import recorded_agent
from rigs.recorded_agent import ScriptedShell, ScriptedStream

KEY = '5a' * 32


def done(request: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Return a valid answer to any request."""
    return recorded_agent.answer('status', **{'lost': 0, 'id': request['id'], **changes})


def ending(seq: int) -> dict[str, Any]:
    return {'event': 'ending', 'reason': 'asked to', 'seq': seq}


def agent(next_seq: int = 1, **status: Any) -> ScriptedStream:
    def answer(request: dict[str, Any]) -> list[Any]:
        return [done(request, next=next_seq, **status)]
    return ScriptedStream(answer)


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., AgentClient]]:
    clients: list[AgentClient] = []

    def build(
        *streams: Any, silence: float = connection.SILENCE, restart: float = connection.RESTART,
        patience: float = connection.PATIENCE, refusal: float = connection.REFUSAL,
    ) -> AgentClient:
        monkeypatch.setattr(connection, 'SILENCE', silence)
        monkeypatch.setattr(connection, 'RESTART', restart)
        monkeypatch.setattr(connection, 'PATIENCE', patience)
        monkeypatch.setattr(connection, 'REFUSAL', refusal)
        shell: Any = ScriptedShell(*streams)
        clients.append(AgentClient(shell, '/run/x', agent_path='/run/x/agent.py'))
        return clients[-1]
    yield build
    for client in clients:
        client.close()


def followed(client: AgentClient) -> list[dict[str, Any]]:
    """Subscribe to the events of an agent; return them as they come."""
    seen: list[Any] = []
    client.subscribe(seen.append, since=1)
    until(lambda: client._shell.opened[0].asked)
    return seen


def request(client: AgentClient, command: str) -> Future[Any]:
    """Send a request in a thread."""
    return in_thread(lambda: client.request(command))


def until(probe: Callable[[], Any]) -> None:
    wait_until(lambda: bool(probe()), timeout=60, what='it', longest=0.02)


def test_reply_goes_to_its_request(make):
    def answer(request):
        return [b'motd of a login script\n', b'[1]\n', b'[' * 100_000 + b'\n',
                {'id': 999, 'ok': True},
                done(request, echo=request)]
    client = make(ScriptedStream(answer))
    assert client.request('status', x=1)['echo'] == {'id': 1, 'command': 'status', 'x': 1}
    assert client._shell.command.argv == (
        'python3', '-IS', '/run/x/agent.py', 'connect', '--directory', '/run/x')


def test_ping_before_the_subscription_does_not_replace_it(make):
    def answer(request):
        return [done(request, next=1)]
    stream = ScriptedStream(answer)
    client = make(stream, silence=0.2)
    client.request('configure')
    until(lambda: any(request['command'] == 'ping' for request in stream.asked))
    # answered in order, so the ping's answer has been read
    client.request('configure')
    client.subscribe(lambda event: None, since=1)
    until(lambda: any(request['command'] == 'log' for request in stream.asked))


def test_refusal_carries_its_hint(make):
    client = make(ScriptedStream(lambda request: [
        {'id': request['id'], 'ok': False, 'error': 'no', 'hint': 'do x'}]))
    with pytest.raises(AgentError) as caught:
        client.request('start')
    assert (caught.value.args[0], caught.value.hint) == ('no', 'do x')


def test_no_reply_in_time(make):
    client = make(ScriptedStream(lambda request: []))
    with pytest.raises(DeadlineExceeded, match="didn't answer 'status' within 0.05 s"):
        client.request('status', timeout=0.05)


def test_events_arrive_once_and_in_order_over_connections(make):
    first, second = agent(), agent(next_seq=6)
    client = make(first, ConnectError('not yet'), second)
    seen = followed(client)
    for seq in (1, 2, 2, 3):
        first.say(ending(seq))
    first.say(None)
    until(lambda: second.asked)
    assert second.asked[0]['from'] == 4
    for seq in (3, 4, 5):
        second.say(ending(seq))
    until(lambda: len(seen) == 7)
    assert [e.get('seq', e.get('state')) for e in seen] == [1, 2, 3, 'lost', 'back', 4, 5]


def gaps(seen: list[dict[str, Any]]) -> list[int]:
    return [event['count'] for event in seen if event['event'] == 'gap']


def test_events_that_are_missing_between_others_are_counted(make):
    stream = agent()
    client = make(stream)
    seen = followed(client)
    for seq in (1, 2, 9, 10):
        stream.say(ending(seq))
    until(lambda: len(seen) == 5)
    assert [event.get('seq') for event in seen] == [1, 2, None, 9, 10] and gaps(seen) == [6]


def test_events_that_the_log_has_lost_are_counted_once(make):
    stream = agent(next_seq=9, first=6, lost=5)
    client = make(stream)
    seen = followed(client)
    for seq in (6, 7):
        stream.say(ending(seq))
    until(lambda: len(seen) == 3)
    assert [event.get('seq') for event in seen] == [None, 6, 7] and gaps(seen) == [5]


def test_new_log_of_an_agent_is_read_from_its_beginning(make):
    first, second = agent(next_seq=60), agent(next_seq=3)
    client = make(first, second)
    seen = followed(client)
    first.say(ending(59))
    until(lambda: seen)
    first.say(None)
    def logs() -> list[Any]:
        return [request['from'] for request in second.asked if request['command'] == 'log']
    until(lambda: len(logs()) == 2)
    assert logs() == [60, 1]
    second.say(ending(1))
    until(lambda: seen[-1].get('seq') == 1)


def test_lost_requests_are_repeated_except_signals(make):
    mute = ScriptedStream(lambda request: [])
    client = make(mute, agent())
    stopping, signalling = request(client, 'stop'), request(client, 'signal')
    until(lambda: len(mute.asked) == 2)
    mute.say(None)
    assert stopping.result(60)['ok'] is True
    assert 'connection was lost' in str(signalling.exception(60))


def test_machine_without_agent_is_given_up(make):
    client = make(ScriptedStream(lambda request: [
        {'error': 'no agent serves /run/x', 'kind': 'absent'}, None]), agent())
    with pytest.raises(AgentError, match='no agent serves /run/x'):
        client.request('status')
    with pytest.raises(AgentError, match='no agent serves /run/x'):
        client.request('status')


def absent() -> ScriptedStream:
    stream = ScriptedStream(lambda request: [])
    stream.say({'error': 'no agent serves /run/x', 'kind': 'absent'})
    stream.say(None)
    return stream


def test_agent_that_pauses_before_its_restart_is_awaited(make):
    first = ScriptedStream(lambda request: [done(request)])
    client = make(first, *(absent() for _ in range(4)), agent(), patience=0.2)
    client.request('status')
    first.answer = lambda request: [None]
    # the launch goes on; its way down does not wait for as long
    waiting = request(client, 'status')
    with pytest.raises(AgentAbsent, match='the agent has ended'):
        client.request('release', silent=60.0)
    assert waiting.result(60)['ok'] is True


def test_time_without_a_network_is_no_time_without_an_agent(make):
    first = agent()
    client = make(first, *(ConnectError('down') for _ in range(4)), absent(), agent(), restart=0.3)
    seen = followed(client)
    first.say(None)
    until(lambda: len(seen) == 2)
    assert [e['state'] for e in seen] == ['lost', 'back']


def test_agent_that_does_not_come_back_is_given_up(make):
    # it may take a moment to restart
    first, second = agent(), agent()
    client = make(first, absent(), absent(), second, *(absent() for _ in range(50)), restart=0.5)
    seen = followed(client)
    client.request('status')
    first.say(None)
    until(lambda: len(seen) == 2)
    second.say(None)
    until(lambda: len(seen) == 4)
    assert [e['state'] for e in seen] == ['lost', 'back', 'lost', 'absent']


def test_program_that_ends_without_output_is_given_up(make):
    streams = [ScriptedStream(lambda request: []) for _ in range(50)]
    for stream in streams:
        stream.say(b'python3: can not open file\n')
        stream.say(None)
    client = make(*streams, patience=0.3)
    with pytest.raises(AgentError, match='without an answer'):
        client.request('status')
    assert len(client._shell.opened) < 6


def given_up(client: AgentClient, first: ScriptedStream) -> list[str]:
    """Lose the connection; return its states until the agent is given up."""
    seen = followed(client)
    first.say(None)
    until(lambda: seen and seen[-1]['state'] == 'absent')
    return [event['state'] for event in seen]


def test_machine_that_keeps_refusing_the_key_is_given_up(make):
    first = agent()
    client = make(first, *(AuthenticationError('key refused') for _ in range(50)), refusal=0.3)
    assert given_up(client, first) == ['lost', 'absent']
    with pytest.raises(AgentError, match='key refused'):
        client.request('status')


def test_machine_with_another_host_key_is_given_up_at_once(make):
    first = agent()
    assert given_up(make(first, HostKeyError('changed'), agent()), first) == ['lost', 'absent']


@pytest.mark.parametrize('kind', [
    AuthenticationError, ConfigurationError, PrerequisiteError, ShellError])
def test_error_of_one_attempt_to_reconnect_is_passing(make, kind):
    first = agent()
    client = make(first, kind('for a moment'), agent())
    seen = followed(client)
    first.say(None)
    until(lambda: len(seen) == 2)
    assert [event['state'] for event in seen] == ['lost', 'back']


def test_close_ends_the_thread_and_waiting_requests(make):
    stream = ScriptedStream(lambda request: [])
    client = make(stream)
    asking = request(client, 'status')
    until(lambda: stream.asked)
    client.close()
    assert 'closed' in str(asking.exception(60))
    with pytest.raises(AgentError, match='closed'):
        client.request('status')


def test_request_of_a_subscriber_raises(make):
    stream = agent()
    client = make(stream)
    caught: list[Exception] = []

    def subscriber(event: dict[str, Any]) -> None:
        try:
            client.request('status')
        except RuntimeError as error:
            caught.append(error)
    client.subscribe(subscriber, since=1)
    stream.say(ending(1))
    until(lambda: caught)
    assert 'subscriber' in str(caught[0])


def test_silent_connection_is_replaced(make):
    mute = ScriptedStream(lambda request: [
        done(request, next=1)] if request['command'] == 'log' else [])
    second = agent()
    # a busy computer may take a while over a thread's turn
    client = make(mute, second, silence=0.8)
    seen = followed(client)
    until(lambda: len(seen) == 2)
    assert 'ping' in [request['command'] for request in mute.asked]
    assert [e['state'] for e in seen] == ['lost', 'back']
    # one that answers is kept
    until(lambda: sum(request['command'] == 'ping' for request in second.asked) > 4)
    assert len(seen) == 2


class SlowStream(ScriptedStream):
    """An agent behind a link of 160 kB/s."""

    def __init__(self, answer: Callable[[dict[str, Any]], list[Any]]) -> None:
        super().__init__(answer)
        self.closed = threading.Event()

    def write(self, data: bytes) -> None:
        if self.closed.wait(len(data) / 160e3):
            raise ConnectError('closed')
        super().write(data)

    def close(self) -> None:
        self.closed.set()
        super().close()


def test_long_request_passes_a_slow_link_also_again(make):
    breaking = ScriptedStream(lambda request: [None] if request['command'] == 'start' else [])
    client = make(breaking, SlowStream(lambda request: [done(request, known=[])]), silence=1.5)
    client.request('start', nodes='x' * 400_000, timeout=1.5)
    assert len(client._shell.opened) == 2


class FullStream(ScriptedStream):
    """
    An agent of a hijacked machine that talks, but takes nothing, or long requests slowly.

    :param pieces: after so many pieces of a request, it ends the connection.
    """

    def __init__(self, pause: float | None, pieces: float = inf) -> None:
        super().__init__(lambda request: [])
        self.pause, self.pieces = pause, pieces
        self.closed = threading.Event()

    def write(self, data: bytes) -> None:
        if len(data) < connection.PIECE:
            return
        self.pieces -= 1
        if self.pieces < 0 or self.closed.wait(self.pause):
            self.close()
            raise ConnectError('closed')

    def readline(self) -> bytes:
        return b'' if self.closed.wait(0.05) else b'{"event": "x"}\n'

    def close(self) -> None:
        self.closed.set()


@pytest.mark.parametrize('pause', [None, 0.2])
def test_machine_that_takes_nothing_holds_no_request(make, pause):
    client = make(FullStream(pause), silence=1.0)
    long = in_thread(lambda: client.request('start', nodes='x' * 200_000))
    until(lambda: client._pending)
    for _ in range(2):
        ending = in_thread(lambda: client.request('stop', timeout=0.1, silent=5.0))
        with pytest.raises(DeadlineExceeded, match="didn't answer 'stop'"):
            ending.result(10.0)
    client.close()
    with pytest.raises((AgentError, DeadlineExceeded)):
        long.result(2.0)


def test_short_request_waits_for_a_long_one_on_a_slow_link(make):
    stream = FullStream(0.05)
    client = make(stream, silence=4.0)
    long = in_thread(lambda: client.request('start', nodes='x' * 20 * connection.PIECE))
    until(lambda: client._sending)
    begin = time.monotonic()
    with pytest.raises(DeadlineExceeded, match="didn't answer 'stop'"):
        client.request('stop', timeout=0.3)
    assert time.monotonic() - begin > 0.6
    stream.close()
    client.close()
    with pytest.raises((AgentError, DeadlineExceeded)):
        long.result(2.0)


def test_request_that_is_taken_again_and_again_holds_no_other(make):
    client = make(*(FullStream(0.2, 9) for _ in range(100)), silence=1.0)
    long = in_thread(lambda: client.request('start', nodes='x' * 10 * connection.PIECE))
    until(lambda: client._sending)
    with pytest.raises(DeadlineExceeded, match="didn't answer 'release'"):
        in_thread(lambda: client.request('release', timeout=1.5, silent=5.0)).result(8.0)
    client.close()
    with pytest.raises((AgentError, DeadlineExceeded)):
        long.result(2.0)


def test_long_request_ends_on_a_link_that_is_too_slow(make):
    client = make(FullStream(0.2), silence=0.4)
    with pytest.raises(DeadlineExceeded, match="didn't answer 'start'"):
        in_thread(lambda: client.request(
            'start', nodes='x' * 3 * connection.PIECE, timeout=0.1)).result(2.0)


#: Messages of a hijacked machine, and the field of each that is wrong; test_untrusted.py has more.
INVALID = [
    ('{"event": null}', 'event'),
    ('{"event": "started", "node": "n", "name": "n", "cmd": []}', 'pid'),
    ('{"event": "unheard of", "seq": "x"}', 'seq'),
    ('{"id": 2, "ok": true}', 'machine'),
    ('{"id": 2, "ok": false, "error": []}', 'error'),
    ('{"id": 1, "ok": true, "first": 1, "next": 1, "lost": %s}' % ('9' * 400), 'lost'),
    ('{"id": 1, "ok": false}', 'first'),
    ('[' * 100_000, 'not an event or an answer'),
]


@pytest.mark.parametrize(('line', 'field'), INVALID, ids=lambda text: text[:40])
def test_invalid_message_is_reported_once_and_fails_the_machine(make, line, field):
    stream = ScriptedStream(lambda request: [])
    client = make(stream, agent())
    seen = followed(client)
    asking = request(client, 'status')
    until(lambda: len(stream.asked) == 2)
    stream.say({'event': 'unheard of'})  # from a newer agent: ignored
    stream.say(line.encode() + b'\n')
    stream.say(ending(1))
    error = str(asking.exception(60))
    assert 'sent an invalid message' in error and field in error
    until(lambda: not client._thread.is_alive())
    assert [(e['event'], e.get('state')) for e in seen] == [('connection', 'absent')]
    assert field in seen[0]['error'] and len(client._shell.opened) == 1
    with pytest.raises(AgentError, match='sent an invalid message'):
        client.status()


@pytest.mark.parametrize('name', ['lost', 'connection', 'gap'])
def test_agent_cannot_forge_events_of_the_robot(make, name):
    stream = agent()
    client = make(stream)
    seen = followed(client)
    stream.say({'event': name, 'seq': 1, 'state': 'absent', 'reason': 'x', 'count': 1})
    stream.say(ending(2))
    until(lambda: seen)
    assert [event['event'] for event in seen] == ['ending']


def test_torn_line_at_the_end_of_a_connection_is_no_fault(make):
    first = agent()
    client = make(first, agent())
    seen = followed(client)
    client.status()
    first.say(b'{"event": "outp')
    first.say(None)
    until(lambda: len(seen) == 2)
    assert [e['state'] for e in seen] == ['lost', 'back']


def test_heartbeats_are_sent_and_answers_measured():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as machine:
        machine.bind(('127.0.0.1', 0))
        machine.settimeout(60)
        heartbeat = Heartbeat('127.0.0.1', machine.getsockname()[1], KEY, interval=0.05)
        for number in (1, 2, 3):
            data, robot = machine.recvfrom(2048)
            beat = verify(KEY, BEAT, data)
            assert beat is not None and beat[0] == number
        for nonsense in (b'', b'[' * 2000, data, b'{"launch": "x", "t": 1.0}',
                         sign('a5' * 32, ANSWER.pack(*beat, time.time())),
                         sign(KEY, ANSWER.pack(number, 0.0, nan)),
                         sign(KEY, ANSWER.pack(number, -inf, 0.0)), sign(KEY, b'{"t": 0}')):
            machine.sendto(nonsense, robot)
        machine.recvfrom(2048)
        assert heartbeat.round_trip is None and heartbeat.age is None
        machine.sendto(sign(KEY, ANSWER.pack(*beat, time.time() - 3600)), robot)
        until(lambda: heartbeat.round_trip is not None)
        assert heartbeat.clock_offset.exceeds and -3601 < heartbeat.clock_offset.seconds < -3590
        assert heartbeat.round_trip < 5 and heartbeat.age is not None
        heartbeat.close()
        assert not heartbeat._thread.is_alive()


@pytest.mark.parametrize('address', ['127.0.0.1', '255.255.255.255'])
def test_heartbeats_continue_while_the_network_is_down(address):
    # a port that answers 'refused', and an address that may not be sent to
    heartbeat = Heartbeat(address, 9, KEY, interval=0.02)
    heartbeat._thread.join(0.2)
    assert heartbeat._thread.is_alive() and heartbeat.round_trip is None
    heartbeat.close()


@pytest.mark.parametrize(('robot_timeout', 'interval'), [
    (120.0, 2.0), (8.0, 2.0), (2.0, 0.5), (0.1, 0.25)])
def test_heartbeats_are_frequent_enough(robot_timeout, interval):
    assert interval_for(robot_timeout) == interval
