# SPDX-License-Identifier: Apache-2.0
"""Connect the robot to a pod's multiplexer: one ``exec``, many channels."""

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
from fogros2.shell.kubernetes_channel import Channel

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

    @property
    def alive(self) -> bool:
        """Whether new commands can start."""
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
                if self._pop_frame() is not None:
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
            channel.lose(self._error)

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
            self._frames()
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

    def _pop_frame(self) -> Optional[tuple[int, int, bytes]]:
        if len(self._incoming) < mux.HEADER.size:
            return None
        kind, number, size = mux.HEADER.unpack_from(self._incoming)
        end = mux.HEADER.size + size
        if size > 1 << 20:
            raise ConnectError(f"'{self._name}' sends what is no frame")
        if len(self._incoming) < end:
            return None
        payload = bytes(self._incoming[mux.HEADER.size:end])
        del self._incoming[:end]
        return kind, number, payload

    def _frames(self) -> None:
        while (found := self._pop_frame()) is not None:
            kind, number, payload = found
            channel = self._channels.get(number)
            if channel is not None:
                channel.take(kind, payload)


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

