# SPDX-License-Identifier: Apache-2.0
"""The robot's connection to a pod's multiplexer, by one ``exec``."""

from __future__ import annotations

import contextlib
from pathlib import Path
import ssl
import struct
import time
from typing import Any, TYPE_CHECKING

from fogros2 import kubernetes_client, untrusted
from fogros2.errors import ConnectError, DeadlineExceeded, FogError, ShellError
from fogros2.kubernetes_client import ApiError, Unreachable
from fogros2.model import Endpoint
from fogros2.shell import multiplexed
from fogros2.shell import multiplexer as mux

if TYPE_CHECKING:
    import websocket

#: Time-out of a partly transferred frame, in seconds. Its thread holds the lock, so a cut in the
#: middle of a frame would block all other threads, including the end of the launch.
STALL = 10.0
_STDIN, _STDOUT, _STDERR, _ERROR = range(4)
#: Last bytes of an error before the first frame.
_ERRORS = 4096
#: Program that reads the multiplexer's source from the start of its standard input.
_LOADER = ('import os,sys;n={size};s=b""\n'
           'while len(s)<n:\n'
           ' d=os.read(0,n-len(s))\n'
           ' if not d:sys.exit(1)\n'
           ' s+=d\n'
           'exec(compile(s,"fogros2","exec"))')


class Link(multiplexed.Link):
    """
    A connection to a pod's multiplexer; thread-safe.

    :param name: the machine's name, for messages.
    :param timeout: time-out of the connection's set-up, in seconds.
    :raises ConnectError: the pod cannot be reached.
    """

    def __init__(self, endpoint: Endpoint, *, name: str, timeout: float) -> None:
        self._name = name
        self._context, self._namespace, self._pod = parse_host(endpoint.host)
        self._exec = self._connect(timeout)
        assert self._exec.sock is not None
        super().__init__(self._exec.sock, name, endpoint.user or 'root')

    def _errors(self) -> tuple[type[BaseException], ...]:
        return _websocket_errors()

    def _write(self, data: bytes) -> None:
        self._exec.send_binary(bytes([_STDIN]) + data)

    def _pending(self) -> bool:
        return isinstance(self._socket, ssl.SSLSocket) and self._socket.pending() > 0

    def _read(self) -> bytes:
        data = _bytes(self._exec.recv())
        if not data:
            raise ConnectError(f"'{self._name}' has closed the connection")
        if data[0] == _ERROR:
            raise ConnectError(f"the exec on '{self._name}' has ended")
        return data[1:] if data[0] == _STDOUT else b''

    def _lose(self, error: FogError) -> None:
        if not self._closed:
            kubernetes_client.connect(self._context).lost()
        super()._lose(error)

    def _ended(self) -> None:
        self._exec.close(timeout=0)

    # -- the connection -------------------------------------------------------------------------

    def _connect(self, timeout: float) -> websocket.WebSocket:
        """Start an ``exec``, and wait for the multiplexer's first frame."""
        source = Path(mux.__file__).read_bytes()
        words = ['python3', '-ISc', _LOADER.format(size=len(source))]
        api = kubernetes_client.connect(self._context)
        try:
            link = api.websocket(
                kubernetes_client.path('pods', self._namespace, self._pod, 'exec'),
                {'container': 'machine', 'command': words, 'stdin': 'true', 'stdout': 'true',
                 'stderr': 'true', 'tty': 'false'}, timeout=timeout)
        except ApiError as error:
            api.doubt(error, kubernetes_client.path('pods', self._namespace, self._pod))
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
        """Wait for the multiplexer's first frame; nothing follows before the first request."""
        errors, incoming = b'', bytearray()
        while True:
            link.settimeout(max(0.1, deadline - time.monotonic()))
            data = _bytes(link.recv())
            kind, data = (data[0], data[1:]) if data else (_ERROR, b'')
            if kind == _STDERR:
                errors = (errors + data)[-_ERRORS:]
            elif kind == _ERROR:
                raise self._no_program(errors + data)
            elif kind == _STDOUT:
                incoming += data
                if list(mux.frames(incoming)):
                    return
            if time.monotonic() > deadline:
                raise DeadlineExceeded(f"'{self._name}' doesn't answer")

    def _no_program(self, stderr: bytes) -> FogError:
        text = stderr.decode(errors='replace')
        if 'python3' in text and ('not found' in text or 'no such file' in text.lower()):
            return ShellError(
                f"the image of '{self._name}' has no python3",
                'take one that has, such as ros:jazzy-ros-base; `ros2 fog image create` makes one')
        with contextlib.suppress(untrusted.InvalidMessage):
            text = untrusted.parsed(text, dict[str, Any]).get('message', text)
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
                'let it create and get pods/exec: packaging/kubernetes/role.yaml has all that a '
                'robot needs')
        if 'not found' in message or 'completed' in message or error.status in (400, 401):
            return ShellError(f"'{self._name}' takes no commands: {message}", error.hint)
        return ConnectError(f"'{self._name}' can't be reached: {message}", error.hint)


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


def _bytes(data: str | bytes) -> bytes:
    return data.encode() if isinstance(data, str) else data


def _websocket_errors() -> tuple[type[BaseException], ...]:
    import websocket
    return (websocket.WebSocketException, OSError, ValueError, struct.error, IndexError)
