# SPDX-License-Identifier: Apache-2.0
"""A connection to a machine's agent: requests, and events that survive a lost connection."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import itertools
import math
import queue
import threading
import time
from typing import Any, cast, Literal, Optional

from fogros2 import events, untrusted
from fogros2.errors import (
    AgentAbsent,
    AgentError,
    Cancelled,
    ConnectError,
    DeadlineExceeded,
    FogError,
    HostKeyError,
)
from fogros2.model import Command, to_json
from fogros2.shell import Shell, Stream
from fogros2.waiting import Periodic, wait_until

#: Seconds without data, although a ping was sent, after which a connection counts as lost. TCP
#: would need 15 minutes after the robot has changed networks.
SILENCE = 20.0
#: Seconds that an agent may need to restart: its longest pause, and its start.
RESTART = 35.0
#: Seconds after which nobody waits for it on the way down, or for a program without an answer.
PATIENCE = 5.0
#: Seconds for which each attempt to reconnect may fail for another reason than the network: a
#: refused login, or too little memory on this computer.
REFUSAL = 300.0

#: Bytes of a long request that are written at once.
PIECE = 1 << 14

EventCallback = Callable[[events.Event], None]


class _Pending:
    """
    A request, which may wait for its reply.

    :ivar slow: seconds for which the link may still take its pieces, on all connections together.
    """

    def __init__(self, number: int, command: str, **arguments: Any) -> None:
        self.command = command
        self.line = to_json({'id': number, 'command': command, **arguments}).encode() + b'\n'
        self.slow = len(self.line) // PIECE * SILENCE / 4
        self.done = threading.Event()
        self.reply: dict[str, Any] = {}


class AgentClient:
    """
    A connection to a machine's agent that reconnects after a loss.

    One thread writes, as a machine may take nothing. Another reads, and checks each message
    against ``fogros2.events``. It passes each event to the subscriber, once and in order, and adds
    ``ConnectionChanged`` and ``Gap``. It gives up an agent that sends an invalid message, as one
    that is gone.
    The subscriber must not make requests: its own thread would have to read their replies.

    :param shell: reaches the machine.
    :param directory: the agent's directory on the machine.
    :param agent_path: path of ``agent.py`` on the machine.
    """

    def __init__(self, shell: Shell, directory: str, *, agent_path: str) -> None:
        self._shell = shell
        self._command = Command(
            # -IS: the agent needs only the standard library, and searching for more takes time
            ('python3', '-IS', agent_path, 'connect', '--directory', directory),
            what='reach the agent')
        self._callback: Optional[EventCallback] = None
        self._closed = threading.Event()
        self._lock = threading.Lock()
        #: Requests to write, each with its connection; None ends the writing thread.
        self._lines: queue.SimpleQueue[Optional[tuple[Stream, _Pending]]] = queue.SimpleQueue()
        self._heard = 0.0
        #: Seconds in which the link took pieces of long requests.
        self._sending = 0.0
        self._numbers = itertools.count(1)
        self._pending: dict[int, _Pending] = {}
        #: The launch that has configured the agent with this client, as all requests then say.
        self._of: dict[str, str] = {}
        self._stream: Optional[Stream] = None
        self._error: Optional[AgentError] = None
        #: Whether an agent has answered, and whether the connection to it is lost.
        self._agent: Literal['awaited', 'here', 'lost'] = 'awaited'
        self._absent: Optional[str] = None
        #: When an agent that had answered was first absent; None while it is there.
        self._absent_since: Optional[float] = None
        self._next: Optional[int] = None
        #: The id of the request whose reply says where the log begins; 0 is a ping's.
        self._log_request = -1
        self._thread: Optional[threading.Thread] = None

    @property
    def silent_for(self) -> float:
        """
        Seconds since the last data from the machine, or since the link took a piece of a long
        request; normally up to ``SILENCE / 4``.
        """
        return time.monotonic() - self._heard

    def connect(self) -> None:
        """
        Open the connection now instead of with the first request; idempotent.

        :raises ConnectError: the machine cannot be reached.
        :raises AgentError: the connection was closed.
        """
        with self._lock:
            if self._thread is not None:
                return
            if self._closed.is_set():
                raise AgentError('the connection to the agent was closed')
            self._stream = self._shell.open(self._command)
            self._heard = time.monotonic()
            self._thread = threading.Thread(
                target=self._read_all, name='fogros2-agent', daemon=True)
            self._thread.start()
            threading.Thread(
                target=self._write_all, name='fogros2-agent-write', daemon=True).start()
            Periodic('fogros2-agent-watch', SILENCE / 4, self._watch, stop=self._closed)

    def request(
        self, command: str, *, timeout: float = 30.0, silent: Optional[float] = None,
        **arguments: Any,
    ) -> dict[str, Any]:
        """
        Send a request to the agent and return its reply.

        If the connection breaks, the client reconnects and repeats the request, except ``signal``,
        which would take effect twice.

        :param timeout: seconds, including the time of lost connections, but not the time in which
            the link takes long requests, of which each ``PIECE`` has ``SILENCE / 4``.
        :param silent: seconds without any data after which the request fails earlier; must be more
            than half of ``SILENCE``, because a busy agent still answers pings. An absent agent
            then gets ``PATIENCE`` seconds instead of ``RESTART``.
        :raises AgentError: refused, with the agent's hint; or no agent is there (any more).
        :raises DeadlineExceeded: no reply in time.
        """
        if threading.current_thread() is self._thread:
            raise RuntimeError('a subscriber must not make requests')
        self.connect()
        number = next(self._numbers)
        pending = _Pending(number, command, **self._of, **arguments)
        with self._lock:
            if self._error is not None:
                raise self._error
            self._pending[number] = pending
            stream = self._stream
        if stream is not None:
            self._lines.put((stream, pending))
        begin = self._clock()
        deadline = begin + timeout
        try:
            while not pending.done.wait(min(0.1, max(0.0, deadline - self._clock()))):
                if self._clock() >= deadline:
                    raise DeadlineExceeded(
                        f"the agent didn't answer '{command}' within {timeout:g} s")
                if silent is not None and min(self.silent_for, self._clock() - begin) > silent:
                    raise DeadlineExceeded(
                        f"the agent sent nothing for {silent:g} s and didn't answer '{command}'")
                absent_since = self._absent_since
                if silent is not None and absent_since is not None \
                        and time.monotonic() - absent_since > PATIENCE:
                    raise AgentAbsent('the agent has ended')
        finally:
            with self._lock:
                self._pending.pop(number, None)
        reply = pending.reply
        if isinstance(self._error, AgentAbsent):
            raise self._error
        if not reply.get('ok'):
            raise AgentError(str(reply.get('error', 'refused')), str(reply.get('hint', '')))
        if command == 'configure' and 'launch' in arguments:
            self._of = {'of': arguments['launch']}
        return reply

    def status(self, *, timeout: float = 30.0) -> events.Status:
        """Return the agent's state; see ``request``."""
        return cast(events.Status, self.request('status', timeout=timeout))

    def subscribe(self, callback: EventCallback, since: int) -> None:
        """
        Pass events to ``callback``, each once and in order, across lost connections.

        :param since: first seq, 1 for all that the agent has.
        :raises AgentError: as for ``request``.
        """
        self._callback, self._next = callback, since
        self.connect()
        with self._lock:
            stream = self._stream
        if stream is not None:
            self._follow_on(stream)

    def close(self) -> None:
        """Close the connection; waiting requests fail, and the agent keeps running."""
        self._closed.set()
        with self._lock:
            stream, thread = self._stream, self._thread
        if stream is not None:
            stream.close()
        if thread is not None and thread is not threading.current_thread():
            # a thread that is still connecting notices later; its result is not needed
            thread.join(5.0 if stream is not None else 0.5)

    # -- the reader's thread --------------------------------------------------------------

    def _read_all(self) -> None:
        pause, begin = 0.0, time.monotonic()
        try:
            while not self._closed.is_set():
                if self._read_stream():
                    pause = 0.0
                else:
                    self._judge(begin)
                if self._error is not None:
                    break
                if self._agent == 'here' and not self._closed.is_set():
                    self._agent = 'lost'
                    self._tell({'event': 'connection', 'state': 'lost'})
                if self._closed.wait(pause):
                    break
                pause = min(2 * pause + 0.1, 5.0)
                self._reopen()
                if self._stream is None:
                    break
        finally:
            self._lines.put(None)
            error = self._error or AgentError('the connection to the agent was closed')
            with self._lock:
                self._error = error
                waiting = list(self._pending.values())
            for pending in waiting:
                pending.reply = {'ok': False, 'error': str(error.args[0]), 'hint': error.hint}
                pending.done.set()
        if self._error is not None and not self._closed.is_set():
            self._tell({'event': 'connection', 'state': 'absent', 'error': str(self._error)})

    def _judge(self, begin: float) -> None:
        """
        Give up an agent that did not answer, if it will not come back.

        :param begin: when the client first connected.
        """
        awaited, now = self._agent == 'awaited', time.monotonic()
        if self._absent is not None:
            if self._absent_since is None:
                self._absent_since = now
            if awaited or now - self._absent_since > RESTART:
                self._error = AgentAbsent(self._absent, 'its machine may have ended')
        elif awaited and now - begin > PATIENCE:
            self._error = AgentError(
                'the program that connects to the agent ended without an answer',
                'is python3 on the machine, and agent.py with it?')

    def _read_stream(self) -> bool:
        """Read until the stream ends; return whether an agent answered."""
        stream = self._stream
        assert stream is not None
        self._absent = None
        spoke = False
        try:
            for line in iter(stream.readline, b''):
                self._heard = time.monotonic()
                try:
                    message = _parsed(line)
                except untrusted.InvalidMessage:
                    if spoke and line.endswith(b'\n'):
                        raise
                    continue  # the output of a login script
                if message.get('kind') == 'absent' and 'ok' not in message:
                    self._absent = str(message.get('error'))
                else:
                    spoke, self._absent_since = True, None
                    before, self._agent = self._agent, 'here'
                    if before == 'lost':
                        self._tell({'event': 'connection', 'state': 'back'})
                    if 'event' in message:
                        self._deliver(message)
                    else:
                        self._answer(message)
        except untrusted.InvalidMessage as error:
            self._error = AgentError(
                f'the agent sent an invalid message ({error})',
                'the machine may be hijacked: delete it')
        with self._lock:
            self._stream = None
        stream.close()
        return spoke

    def _deliver(self, message: dict[str, Any]) -> None:
        event, seq = events.event(message), message.get('seq')
        if seq is not None and self._next is not None and seq >= self._next:
            if seq > self._next:
                # so many were lost on the way to the log, or before a slow connection took them
                self._tell({'event': 'gap', 'count': seq - self._next})
            self._next = seq + 1
            if event is not None:
                self._tell(event)

    def _answer(self, message: dict[str, Any]) -> None:
        number = message.get('id')
        if number == self._log_request:
            self._compare_logs(events.answer('log', message))
            return
        with self._lock:
            pending = self._pending.get(number) if isinstance(number, int) else None
        if pending is not None:
            pending.reply = events.answer(pending.command, message)
            pending.done.set()

    def _compare_logs(self, log: dict[str, Any]) -> None:
        """Report events that the agent's log has lost; begin anew with an agent that is new."""
        if log['next'] < (self._next or 1):
            # none of its events was delivered
            self._next = 1
            stream = self._stream
            if log['next'] > 1 and stream is not None:
                self._follow_on(stream)
        elif log['lost'] > 0:
            self._tell({'event': 'gap', 'count': log['lost']})
            self._next = max(self._next or 1, log['first'])

    def _tell(self, event: events.Event) -> None:
        if self._callback is not None:
            self._callback(event)

    def _follow_on(self, stream: Stream) -> None:
        self._log_request = next(self._numbers)
        self._lines.put((stream, _Pending(
            self._log_request, 'log', **self._of, **{'from': self._next})))

    def _ping(self, stream: Stream) -> None:
        """Send a request without a waiting caller; its reply shows that the agent is there."""
        self._lines.put((stream, _Pending(0, 'ping', **self._of)))

    def _write_all(self) -> None:
        while (item := self._lines.get()) is not None:
            stream, request = item
            # after an error of the connection, the reading thread repeats the requests
            with contextlib.suppress(FogError):
                for position in range(0, len(request.line), PIECE):
                    begin = time.monotonic()
                    stream.write(request.line[position:position + PIECE])
                    now = time.monotonic()
                    # a single piece may wait in the buffers of a dead connection
                    if position > 0 and now - begin < SILENCE / 4:
                        self._heard = now
                        # a machine that ends the connection may get the pieces again and again
                        taken = min(now - begin, request.slow)
                        request.slow -= taken
                        self._sending += taken

    def _clock(self) -> float:
        """Return a monotonic time in seconds that stands still while the link takes pieces."""
        return time.monotonic() - self._sending

    def _watch(self) -> None:
        """Ping a silent connection, and close it if nothing comes back."""
        stream, silent = self._stream, time.monotonic() - self._heard
        if stream is None or silent < SILENCE / 4:
            return
        if silent > SILENCE:
            stream.close()
        elif self._lines.empty():  # else the connection takes nothing
            self._ping(stream)

    def _reopen(self) -> None:
        """Reconnect, with increasing pauses, until the client is closed, or refused for long."""
        refused_since = math.inf

        def attempt() -> Optional[Stream]:
            nonlocal refused_since
            try:
                return self._shell.open(self._command)
            except (ConnectError, DeadlineExceeded):
                refused_since = math.inf
            except FogError as error:
                now = time.monotonic()
                refused_since = min(refused_since, now)
                if isinstance(error, HostKeyError) or now - refused_since > REFUSAL:
                    raise
            return None

        try:
            stream = wait_until(
                attempt, timeout=math.inf, what='the agent', cancel=self._closed,
                interval=0.1, longest=5.0)
        except Cancelled:
            return
        except FogError as error:
            self._error = AgentError(f"the agent can't be reached: {error.args[0]}", error.hint)
            return
        if self._closed.is_set():
            stream.close()
            return
        self._heard = time.monotonic()
        with self._lock:
            self._stream = stream
            again = []
            for pending in self._pending.values():
                if pending.command != 'signal':  # which would take effect twice
                    again.append(pending)
                elif not pending.done.is_set():
                    pending.reply = {'ok': False, 'error': 'the connection was lost meanwhile'}
                    pending.done.set()
        if self._next is not None:
            self._follow_on(stream)
        self._ping(stream)
        for pending in again:
            self._lines.put((stream, pending))


def _parsed(line: bytes) -> dict[str, Any]:
    """
    Return a message.

    :raises InvalidMessage: the line is other text.
    """
    what = 'not an event or an answer'
    try:
        message: dict[str, Any] = untrusted.parsed(line, dict[str, Any])
    except untrusted.InvalidMessage as error:
        raise untrusted.InvalidMessage(f'{what}: {error}') from error
    if not message.keys() & {'event', 'ok', 'kind'}:
        raise untrusted.InvalidMessage(what)
    return message
