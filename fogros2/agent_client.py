# SPDX-License-Identifier: Apache-2.0
"""Talk to a machine's agent: requests, events that survive a lost connection, heartbeats."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import itertools
import json
from pathlib import Path
import socket
import threading
import time
from typing import Any, Optional

from fogros2.clock import ClockOffset, OffsetFilter
from fogros2.errors import (
    AgentAbsent,
    AgentError,
    Cancelled,
    ConnectError,
    DeadlineExceeded,
    FogError,
)
from fogros2.model import Command, to_json
from fogros2.shell import Shell, Stream
from fogros2.waiting import wait_until

#: Interval of heartbeats in seconds.
HEARTBEAT_INTERVAL = 2.0
#: Seconds without data after which a connection counts as lost.
SILENCE = 20.0
#: Seconds after which an agent that has gone will not come back.
RESTART = 5.0

#: A request without a waiting caller; its reply shows that the agent is there.
_PING = b'{"id":0,"command":"ping"}\n'

EventCallback = Callable[[dict[str, Any]], None]


def agent_source() -> Path:
    """Return the path of ``agent.py``, which is copied to machines."""
    return Path(__file__).with_name('agent.py')


def cloud_launch_source() -> Path:
    """Return the path of the launch file that runs nodes; it imports launch, not fogros2."""
    return Path(__file__).with_name('cloud_launch.py')


class _Pending:
    """A request that waits for its reply."""

    def __init__(self, line: bytes, repeatable: bool) -> None:
        self.line = line
        self.repeatable = repeatable
        self.done = threading.Event()
        self.reply: dict[str, Any] = {}


class AgentClient:
    """
    A connection to a machine's agent that reconnects after a loss.

    One thread reads. It passes each event to the subscribers, once and in order, and adds events
    without ``seq``: ``{'event': 'connection', 'state': 'lost' | 'back' | 'absent'}``, and
    ``{'event': 'gap', 'count': n}`` if the agent's log has dropped events.
    A subscriber must not make requests: its own thread would have to read their replies.

    :param shell: reaches the machine.
    :param directory: the agent's directory on the machine.
    :param python: interpreter on the machine.
    :param agent_path: path of ``agent.py`` on the machine.
    :param cancel: when set, requests raise Cancelled and no new connection is opened.
    :param silence: seconds without a byte, although a ping was sent, after which a connection
        counts as lost. TCP would need 15 minutes after the robot has changed networks.
    :param restart: seconds that an agent may need to restart.
    """

    def __init__(
        self,
        shell: Shell,
        directory: str,
        *,
        agent_path: str,
        python: str = 'python3',
        cancel: Optional[threading.Event] = None,
        silence: float = SILENCE,
        restart: float = RESTART,
    ) -> None:
        self._shell = shell
        self._command = Command(
            # -IS: the agent needs only the standard library, and searching for more takes time
            (python, '-IS', agent_path, 'connect', '--directory', directory),
            what='reach the agent')
        self._callbacks: list[EventCallback] = []
        self._cancel = cancel or threading.Event()
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._silence = silence
        self._heard = 0.0
        self._numbers = itertools.count(1)
        self._pending: dict[int, _Pending] = {}
        self._stream: Optional[Stream] = None
        self._error: Optional[AgentError] = None
        self._restart = restart
        self._ever = self._lost = False
        self._absent: Optional[str] = None
        self._next: Optional[int] = None
        #: The id of the request whose reply says where the log begins; 0 is a ping's.
        self._log_request = -1
        self._thread: Optional[threading.Thread] = None

    @property
    def next_seq(self) -> int:
        """The lowest seq that the next event may have."""
        return self._next or 1

    @property
    def silent_for(self) -> float:
        """Seconds since the last data from the machine; normally up to ``silence / 4``."""
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
            threading.Thread(target=self._watch, name='fogros2-agent-watch', daemon=True).start()

    def request(
        self, command: str, *, timeout: float = 30.0, silent: Optional[float] = None,
        **arguments: Any,
    ) -> dict[str, Any]:
        """
        Send a request to the agent and return its reply.

        If the connection breaks, the client reconnects and repeats the request, except ``signal``,
        which would take effect twice.

        :param timeout: seconds, including the time of lost connections.
        :param silent: seconds without any data after which the request fails earlier; must be more
            than half of ``silence``, because a busy agent still answers pings.
        :raises AgentError: refused, with the agent's hint; or no agent is there (any more).
        :raises DeadlineExceeded: no reply in time.
        :raises Cancelled: ``cancel`` was set.
        """
        if threading.current_thread() is self._thread:
            raise RuntimeError('a subscriber must not make requests')
        self.connect()
        number = next(self._numbers)
        line = to_json({'id': number, 'command': command, **arguments}).encode() + b'\n'
        pending = _Pending(line, repeatable=command != 'signal')
        with self._lock:
            if self._error is not None:
                raise self._error
            self._pending[number] = pending
            stream = self._stream
        if stream is not None:
            self._send(stream, line)
        begin = time.monotonic()
        deadline = begin + timeout
        try:
            while not pending.done.wait(min(0.1, max(0.0, deadline - time.monotonic()))):
                if self._cancel.is_set():
                    raise Cancelled(f"'{command}' of the agent")
                if time.monotonic() >= deadline:
                    raise DeadlineExceeded(
                        f"the agent didn't answer '{command}' within {timeout:g} s")
                if silent is not None and min(
                        self.silent_for, time.monotonic() - begin) > silent:
                    raise DeadlineExceeded(
                        f"the agent hasn't said a word for {silent:g} s, nor answered '{command}'")
        finally:
            with self._lock:
                self._pending.pop(number, None)
        reply = pending.reply
        if isinstance(self._error, AgentAbsent):
            raise self._error
        if not reply.get('ok'):
            raise AgentError(str(reply.get('error', 'refused')), str(reply.get('hint', '')))
        return reply

    def subscribe(self, callback: EventCallback, since: Optional[int] = None) -> None:
        """
        Pass events to ``callback``, each once and in order, across lost connections.

        The first subscriber decides where to begin; later ones join at the current event.

        :param since: first seq, 1 for all that the agent has; None for new events only.
        :raises AgentError: as for ``request``.
        """
        if since is None and self._next is None:
            since = int(self.request('status')['next'])
        self._callbacks.append(callback)
        if self._next is not None or since is None:
            return
        self._next = since
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
        error: FogError
        pause, quiet_since = 0.0, time.monotonic()
        try:
            while not self._closed.is_set():
                if self._read_stream():
                    pause, quiet_since = 0.0, time.monotonic()
                elif self._hopeless(time.monotonic() - quiet_since):
                    break
                if self._ever and not self._lost and not self._closed.is_set():
                    self._lost = True
                    self._tell({'event': 'connection', 'state': 'lost'})
                if self._closed.wait(pause):
                    break
                pause = min(2 * pause + 0.1, 5.0)
                self._reopen()
                if self._stream is None:
                    break
        finally:
            error = self._error or AgentError('the connection to the agent was closed')
            with self._lock:
                self._error = error
                waiting = list(self._pending.values())
            for pending in waiting:
                pending.reply = {'ok': False, 'error': str(error.args[0]), 'hint': error.hint}
                pending.done.set()
        if self._error is not None and not self._closed.is_set():
            self._tell({'event': 'connection', 'state': 'absent', 'error': str(self._error)})

    def _hopeless(self, seconds: float) -> bool:
        """Return whether to give up an agent that was silent for so many seconds."""
        if self._absent is not None and (not self._ever or seconds > self._restart):
            self._error = AgentAbsent(self._absent, 'its machine may have ended')
        elif not self._ever and seconds > self._restart:
            self._error = AgentError(
                'the program that should reach the agent ends without a word',
                'is python3 on the machine, and agent.py with it?')
        return self._error is not None

    def _read_stream(self) -> bool:
        """Read until the stream ends; return whether an agent answered."""
        stream = self._stream
        assert stream is not None
        self._absent = None
        spoke = False
        for line in iter(stream.readline, b''):
            self._heard = time.monotonic()
            try:
                message = json.loads(line)
            except (ValueError, RecursionError):
                continue  # output of a login script
            if not isinstance(message, dict):
                continue
            if message.get('kind') == 'absent' and 'ok' not in message:
                self._absent = str(message.get('error'))
            elif 'event' in message or 'ok' in message:
                self._ever = spoke = True
                if self._lost:
                    self._lost = False
                    self._tell({'event': 'connection', 'state': 'back'})
                if 'event' in message:
                    self._deliver(message)
                else:
                    self._answer(message)
        with self._lock:
            self._stream = None
        stream.close()
        return spoke

    def _answer(self, reply: dict[str, Any]) -> None:
        number = reply.get('id')
        if number is not None and number == self._log_request:
            if reply.get('next', 0) < self.next_seq:
                # an agent with a new log: none of its events was delivered
                self._next = 1
                stream = self._stream
                if reply.get('next', 0) > 1 and stream is not None:
                    self._follow_on(stream)
            elif reply.get('lost'):
                self._tell({'event': 'gap', 'count': reply['lost']})
            return
        with self._lock:
            pending = self._pending.get(number) if isinstance(number, int) else None
        if pending is not None:
            pending.reply = reply
            pending.done.set()

    def _deliver(self, event: dict[str, Any]) -> None:
        seq = event.get('seq')
        if self._next is None or not isinstance(seq, int) or seq < self._next:
            return
        self._next = seq + 1
        self._tell(event)

    def _tell(self, event: dict[str, Any]) -> None:
        for callback in self._callbacks:
            callback(event)

    def _follow_on(self, stream: Stream) -> None:
        self._log_request = next(self._numbers)
        self._send(stream, to_json({
            'id': self._log_request, 'command': 'log', 'from': self._next, 'follow': True,
        }).encode() + b'\n')

    def _send(self, stream: Stream, line: bytes) -> None:
        """Write a line; after a connection error the reading thread repeats the requests."""
        with self._writing, contextlib.suppress(ConnectError):
            stream.write(line)

    def _watch(self) -> None:
        """Ping a silent connection, and close it if nothing comes back."""
        thread = self._thread
        while thread is not None and thread.is_alive():
            if self._closed.wait(self._silence / 4):
                return
            stream, silent = self._stream, time.monotonic() - self._heard
            if stream is None or silent < self._silence / 4:
                continue
            if silent > self._silence:
                stream.close()
            elif self._writing.acquire(timeout=self._silence / 4):
                # a thread that holds the lock for longer is stuck in a dead connection
                self._writing.release()
                self._send(stream, _PING)

    def _reopen(self) -> None:
        """Reconnect, with increasing pauses, until the client is closed."""
        def attempt() -> Optional[Stream]:
            if self._cancel.is_set():
                raise Cancelled('the connection to the agent')
            try:
                return self._shell.open(self._command)
            except ConnectError:
                return None

        stream = None
        while stream is None:
            try:
                stream = wait_until(
                    attempt, timeout=3600.0, what='the agent', cancel=self._closed,
                    interval=0.1, longest=5.0)
            except DeadlineExceeded:
                continue
            except Cancelled:
                return
            except FogError as error:
                # a changed host key or a refused login key: reconnecting does not help
                self._error = AgentError(f"the agent can't be reached: {error.args[0]}",
                                         error.hint)
                return
        if self._closed.is_set():
            stream.close()
            return
        self._heard = time.monotonic()
        with self._lock:
            self._stream = stream
            again = []
            for pending in self._pending.values():
                if pending.repeatable:
                    again.append(pending.line)
                elif not pending.done.is_set():
                    pending.reply = {'ok': False, 'error': 'the connection was lost meanwhile'}
                    pending.done.set()
        if self._next is not None:
            self._follow_on(stream)
        for line in (_PING, *again):
            self._send(stream, line)


class Heartbeat:
    """
    Send heartbeats to a machine through the VPN; measure the round trip and its clock.

    Starts at once. Lost datagrams, or a VPN that is down for a while, raise no errors.

    :param address: the machine's VPN address.
    :param port: the agent's port on the machine.
    :param launch_id: the launch for which the agent was configured.
    :param interval: seconds between heartbeats.
    """

    def __init__(
        self, address: str, port: int, launch_id: str, interval: float = HEARTBEAT_INTERVAL,
    ) -> None:
        self._target = (address, port)
        self._launch_id = launch_id
        self._interval = interval
        self._stopped = threading.Event()
        self._answered_at: Optional[float] = None
        self._round_trip: Optional[float] = None
        self._offsets = OffsetFilter()
        self._offset: Optional[ClockOffset] = None
        self._thread = threading.Thread(target=self._run, name='fogros2-heartbeat', daemon=True)
        self._thread.start()

    @property
    def round_trip(self) -> Optional[float]:
        """Round-trip time of the last answered heartbeat in seconds, None before the first."""
        return self._round_trip

    @property
    def clock_offset(self) -> Optional[ClockOffset]:
        """The best of the recent measurements; None before the first, or with an older agent."""
        return self._offset

    @property
    def age(self) -> Optional[float]:
        """Seconds since the last answer, None before the first."""
        at = self._answered_at
        return None if at is None else time.monotonic() - at

    def close(self) -> None:
        """Stop; the agent's watchdog then acts after its ``robot_timeout``."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def _run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            number = 0
            while not self._stopped.is_set():
                number += 1
                self._send(link, number)
                self._listen(link, time.monotonic() + self._interval)

    def _send(self, link: socket.socket, number: int) -> None:
        data = to_json({'launch': self._launch_id, 'n': number, 't': time.monotonic()}).encode()
        with contextlib.suppress(OSError):  # no route while the VPN is down
            link.sendto(data, self._target)

    def _listen(self, link: socket.socket, until: float) -> None:
        while not self._stopped.is_set():
            left = until - time.monotonic()
            if left <= 0:
                return
            link.settimeout(min(left, 0.25))
            try:
                data, peer = link.recvfrom(2048)
            except TimeoutError:
                continue
            except OSError:
                # 'connection refused' because the agent does not listen yet; retry
                self._stopped.wait(0.05)
                continue
            now = time.monotonic()
            try:
                answer = json.loads(data)
                if peer == self._target and answer['launch'] == self._launch_id:
                    self._round_trip = now - float(answer['t'])
                    self._answered_at = now
                    self._compare(self._round_trip, answer.get('clock'))
            except (KeyError, TypeError, ValueError, RecursionError):
                continue

    def _compare(self, round_trip: float, clock: Any) -> None:
        """Measure the clock's offset from an answer, if it contains a valid time."""
        if type(clock) in (int, float) and abs(clock) < 1e11 and 0 <= round_trip < SILENCE:
            self._offset = self._offsets.add(round_trip, time.time(), clock)
