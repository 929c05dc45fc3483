# SPDX-License-Identifier: Apache-2.0
"""The robot's end of a pod's multiplexer: a connection by one ``exec``, and its channels."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import functools
import json
from pathlib import Path
import select
import ssl
import struct
import threading
import time
from typing import Optional, TYPE_CHECKING

from fogros2 import kubernetes_client
from fogros2.errors import ConnectError, DeadlineExceeded, FogError, ShellError
from fogros2.kubernetes_client import ApiError, Unreachable
from fogros2.model import Command, Endpoint
from fogros2.shell import kubernetes_mux as mux

if TYPE_CHECKING:
    import websocket

#: Seconds of silence after which the robot sends a ping.
ASK = 15.0
#: Time-out of a partly transferred frame, in seconds. Its thread holds the lock, so a cut in the
#: middle of a frame would block all other threads, including the end of the launch.
STALL = 10.0
_STDIN, _STDOUT, _STDERR, _ERROR = range(4)
#: Program that reads the multiplexer's source from the start of its standard input.
_LOADER = ('import os,sys;n={size};s=b""\n'
           'while len(s)<n:\n'
           ' d=os.read(0,n-len(s))\n'
           ' if not d:sys.exit(1)\n'
           ' s+=d\n'
           'exec(compile(s,"fogros2","exec"))')


class Channel:
    """
    One command in the pod, with the interface of paramiko's Channel.

    :param number: the command's number in frames.
    """

    #: For a command that a signal ended, the multiplexer reports 128 + signal.
    eof_received = 0

    def __init__(self, link: Link, number: int) -> None:
        self._link = link
        self._number = number
        self._changed = threading.Condition()
        self._waiting = {mux.OUT: bytearray(), mux.ERR: bytearray()}
        self._open = {mux.OUT, mux.ERR}
        self._status = -1
        self._timeout: Optional[float] = None
        self._credit = mux.CREDIT
        self._owed = 0
        #: Set when the exit status is known, or will never be known.
        self.status_event = threading.Event()

    # -- from the link --------------------------------------------------------------------------

    def take(self, kind: int, payload: bytes) -> None:
        """Process a frame from the pod."""
        with self._changed:
            if kind == mux.EXIT:
                self._status, = struct.unpack('>i', payload)
                self.status_event.set()
            elif kind == mux.WINDOW:
                self._credit += struct.unpack('>I', payload)[0]
            elif payload:
                self._waiting[kind] += payload
            else:
                self._open.discard(kind)
            self._changed.notify_all()

    def lose(self) -> None:
        """Record that no more frames will arrive."""
        with self._changed:
            self._open.clear()
            self.status_event.set()
            self._changed.notify_all()

    # -- for its user ---------------------------------------------------------------------------

    def get_transport(self) -> Link:
        """Return the channel's connection."""
        return self._link

    def settimeout(self, timeout: Optional[float]) -> None:
        """Set the time-out of reads in seconds, None: no time-out."""
        self._timeout = timeout

    def recv(self, size: int) -> bytes:
        """
        Return up to ``size`` bytes of standard output, b'' at its end.

        :raises TimeoutError: there was no output.
        """
        return self._receive(mux.OUT, size)

    def recv_stderr(self, size: int) -> bytes:
        """Return up to ``size`` bytes of standard error, b'' at its end."""
        return self._receive(mux.ERR, size)

    def recv_stderr_ready(self) -> bool:
        """Return whether standard error has arrived."""
        return bool(self._waiting[mux.ERR])

    def _receive(self, kind: int, size: int) -> bytes:
        with self._changed:
            if not self._changed.wait_for(
                    lambda: self._waiting[kind] or kind not in self._open, self._timeout):
                raise TimeoutError
            data = bytes(self._waiting[kind][:size])
            del self._waiting[kind][:size]
            self._owed += len(data)
            owed = self._owed if self._owed >= mux.CREDIT // 4 else 0
            self._owed -= owed
        if owed:
            with contextlib.suppress(ConnectError):  # what has arrived can be read
                self._link.send(mux.WINDOW, self._number, struct.pack('>I', owed))
        return data

    def exit_status_ready(self) -> bool:
        """Return whether the exit status is known, or will never be known."""
        return self.status_event.is_set()

    def recv_exit_status(self) -> int:
        """Wait for the exit, and return the exit status; -1 if it will never be known."""
        self.status_event.wait()
        return self._status

    def send(self, data: bytes) -> int:
        """
        Send to standard input as much as the command has room for; return the number of bytes.

        :raises OSError: the command has ended, or the channel is lost or closed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._credit > 0 or self.status_event.is_set())
            if self.status_event.is_set():
                raise BrokenPipeError('the command has ended')
            piece = data[:min(mux.CHUNK, self._credit)]
            self._credit -= len(piece)
        self._link.send(mux.IN, self._number, piece)
        return len(piece)

    def sendall(self, data: bytes) -> None:
        """Send to standard input, as fast as the command reads; see ``send``."""
        rest = memoryview(data)
        while rest:
            rest = rest[self.send(bytes(rest[:mux.CHUNK])):]

    def shutdown_write(self) -> None:
        """Close the command's standard input."""
        self._link.send(mux.IN, self._number)

    def resize_pty(self, columns: int, rows: int) -> None:
        """Send the terminal's new size."""
        self._link.send(mux.RESIZE, self._number, struct.pack('>HH', rows, columns))

    def close(self) -> None:
        """Close the channel, which ends a running command."""
        self.lose()
        self._link.forget(self._number)


class Link:
    """
    A connection to a pod's multiplexer; thread-safe.

    :param name: the machine's name, for messages.
    :param timeout: time-out of the connection's set-up, in seconds.
    :raises ConnectError: the pod cannot be reached.
    """

    def __init__(self, endpoint: Endpoint, *, name: str, timeout: float) -> None:
        self._name = name
        self._user = endpoint.user or 'root'
        self._context, self._namespace, self._pod = parse_host(endpoint.host)
        self._lock = threading.Lock()
        self._channels: dict[int, Channel] = {}
        self._next = 1
        self._incoming = bytearray()
        self._error: Optional[FogError] = None
        self._closed = False
        self._socket = self._connect(timeout)
        threading.Thread(target=self._run, name='fog-pod', daemon=True).start()

    def is_alive(self) -> bool:
        """Return whether new commands can start."""
        return self._error is None

    def open(self, command: Command, *, terminal: Optional[tuple[int, int, str]] = None,
             login: bool = False) -> Channel:
        """
        Start a command in the pod.

        :param terminal: rows, columns and type of the command's terminal; None: no terminal.
        :param login: start the user's login shell instead of the command.
        :raises ConnectError: the connection is lost.
        """
        what = {
            'argv': [] if login else list(command.argv), 'env': dict(command.environment),
            'root': command.sudo, 'user': self._user, 'pty': terminal}
        with self._lock:
            number, self._next = self._next, self._next + 1
            channel = Channel(self, number)
            self._channels[number] = channel
        self.send(mux.OPEN, number, json.dumps(what).encode())
        return channel

    def send(self, kind: int, number: int, payload: bytes = b'') -> None:
        """
        Send a frame.

        :raises ConnectError: the connection is lost.
        """
        with self._using() as link:
            link.send_binary(bytes([_STDIN]) + mux.frame(kind, number, payload))

    @contextlib.contextmanager
    def _using(self) -> Iterator[websocket.WebSocket]:
        """Lock the connection; the first error ends the connection for all threads."""
        with self._lock:
            if self._error is not None:
                raise self._error
            try:
                yield self._socket
            except _websocket_errors() as error:
                self._error = self._broken(error)
                self._wake()
                raise self._error from error

    def _broken(self, error: BaseException) -> ConnectError:
        return ConnectError(f"the connection to '{self._name}' was lost: {error}")

    def _wake(self) -> None:
        """Wake the reading thread, which closes the connection."""
        if self._socket.sock is not None:
            with contextlib.suppress(OSError):
                self._socket.sock.shutdown(2)

    def forget(self, number: int) -> None:
        """Close a command's channel."""
        with self._lock:
            known = self._channels.pop(number, None)
        if known is not None:
            with contextlib.suppress(ConnectError):
                self.send(mux.CLOSE, number)

    def close(self) -> None:
        """Close the connection, and end its commands."""
        self._closed = True
        with contextlib.suppress(FogError):
            self.send(mux.GONE, 0)
        self._lose(ConnectError(f"the connection to '{self._name}' was closed"))
        self._wake()

    # -- the connection -------------------------------------------------------------------------

    def _connect(self, timeout: float) -> websocket.WebSocket:
        """Start an ``exec``, and wait for the multiplexer's first frame."""
        source = _source()
        words = ['python3', '-ISc', _LOADER.format(size=len(source))]
        api = kubernetes_client.connect(self._context)
        try:
            link = api.websocket(
                kubernetes_client.path('pods', self._namespace, self._pod, 'exec'),
                {'container': 'machine', 'command': words, 'stdin': 'true', 'stdout': 'true',
                 'stderr': 'true', 'tty': 'false'}, timeout=timeout)
        except ApiError as error:
            raise self._refused(error, passing=api.passing(error)) from error
        except Unreachable as error:
            raise ConnectError(f"'{self._name}' can't be reached: {error.args[0]}", error.hint) \
                from error
        try:
            # In pieces, because some API servers accept only small frames.
            for begin in range(0, len(source), mux.CHUNK):
                link.send_binary(bytes([_STDIN]) + source[begin:begin + mux.CHUNK])
            self._greeting(link, time.monotonic() + timeout)
        except _websocket_errors() as error:
            link.close(timeout=0.1)
            raise ConnectError(f"the connection to '{self._name}' was lost at once: {error}",
                               'is its pod running?') from error
        except FogError:
            link.close(timeout=0.1)
            raise
        link.settimeout(STALL)
        return link

    def _greeting(self, link: websocket.WebSocket, deadline: float) -> None:
        """Wait for the multiplexer's first frame."""
        errors = b''
        while True:
            link.settimeout(max(0.1, deadline - time.monotonic()))
            data = _bytes(link.recv())
            kind, data = (data[0], data[1:]) if data else (_ERROR, b'')
            if kind == _STDERR:
                errors += data
            elif kind == _ERROR:
                raise self._no_program(errors + data)
            elif kind == _STDOUT:
                self._incoming += data
                if list(mux.frames(self._incoming)):
                    return
            if time.monotonic() > deadline:
                raise DeadlineExceeded(f"'{self._name}' doesn't answer")

    def _no_program(self, said: bytes) -> FogError:
        text = said.decode(errors='replace')
        if 'python3' in text and ('not found' in text or 'no such file' in text.lower()):
            return ShellError(
                f"the image of '{self._name}' has no python3",
                'take one that has, such as ros:jazzy-ros-base; `ros2 fog image create` makes one')
        with contextlib.suppress(ValueError):
            text = json.loads(text).get('message', text)
        return ConnectError(f"'{self._name}' can not begin a command: {' '.join(text.split())}")

    def _refused(self, error: ApiError, *, passing: bool) -> FogError:
        message = str(error.args[0])
        if passing and 'not found' not in message:
            return ConnectError(f"'{self._name}' can't be reached: {message}", error.hint)
        if error.status == 404:
            return ShellError(f"the pod of '{self._name}' is gone: {message}")
        if error.status == 403:
            return ShellError(
                f"this user may not run commands on '{self._name}': {message}",
                'let it create and get pods/exec: deploy/kubernetes/role.yaml has all that a '
                'robot needs')
        if 'not found' in message or 'completed' in message or error.status in (400, 401):
            return ShellError(f"'{self._name}' takes no commands: {message}", error.hint)
        return ConnectError(f"'{self._name}' can't be reached: {message}", error.hint)

    # -- reading --------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._serve()
        except FogError as error:
            lost = error
        except _websocket_errors() as error:
            lost = self._broken(error)
        if not self._closed:
            kubernetes_client.connect(self._context).lost()
        self._lose(lost)
        with self._lock, contextlib.suppress(*_websocket_errors()):
            self._socket.close(timeout=0)

    def _lose(self, error: FogError) -> None:
        with self._lock:
            self._error = self._error or error
            channels = list(self._channels.values())
            self._channels.clear()
        for channel in channels:
            channel.lose()

    def _serve(self) -> None:
        """
        Dispatch the frames from the pod to their channels.

        :raises ConnectError: the connection is lost or closed.
        """
        sock = self._socket.sock
        assert sock is not None
        poll = select.poll()
        poll.register(sock, select.POLLIN)
        heard = time.monotonic()
        while True:
            for kind, number, payload in mux.frames(self._incoming):
                channel = self._channels.get(number)
                if channel is not None:
                    channel.take(kind, payload)
            pending = isinstance(sock, ssl.SSLSocket) and sock.pending()
            if not pending and not poll.poll(ASK * 1000):
                if time.monotonic() - heard > 3 * ASK:
                    raise ConnectError(f"'{self._name}' has fallen silent")
                self.send(mux.PING, 0)
                continue
            # Under the lock, because TLS has one state for reading and writing.
            with self._using() as link:
                data = _bytes(link.recv())
            if not data:
                raise ConnectError(f"'{self._name}' has closed the connection")
            heard = time.monotonic()
            if data[0] == _STDOUT:
                self._incoming += data[1:]
            elif data[0] == _ERROR:
                raise ConnectError(f"the exec on '{self._name}' has ended")


def parse_host(host: str) -> tuple[str, str, str]:
    """
    Parse an endpoint's host into context, namespace and pod.

    :raises ConnectError: the host names no pod.

    >>> parse_host('robots/fogros2-talker-x7c2p@arn:aws:eks:eu-north-1:1:cluster/a')
    ('arn:aws:eks:eu-north-1:1:cluster/a', 'robots', 'fogros2-talker-x7c2p')
    """
    where, _, context = host.partition('@')
    namespace, _, pod = where.partition('/')
    if not namespace or not pod:
        raise ConnectError(f"'{host}' names no pod")
    return context, namespace, pod


@functools.lru_cache(maxsize=1)
def _source() -> bytes:
    return Path(mux.__file__).read_bytes()


def _bytes(data: str | bytes) -> bytes:
    return data.encode() if isinstance(data, str) else data


def _websocket_errors() -> tuple[type[BaseException], ...]:
    import websocket
    return (websocket.WebSocketException, OSError, ValueError, struct.error, IndexError)

