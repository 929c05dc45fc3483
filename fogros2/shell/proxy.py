# SPDX-License-Identifier: Apache-2.0
"""A connection to a program of this computer, such as OpenSSH's ``ProxyCommand``."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
import subprocess
import time
from typing import Any, Optional

from fogros2 import process
from fogros2.errors import ConnectError
from fogros2.model import Command

#: Seconds in which a program takes nothing until the connection counts as lost.
STUCK = 60.0
#: Maximum bytes of a packet of SSH; OpenSSH's is 256 kB.
_PACKET = 1 << 19


class PacketSocket(socket.socket):
    """A socket for packets of SSH."""

    def recv(self, size: int, flags: int = 0) -> bytes:
        """
        Receive.

        :raises EOFError: the server announces a packet that would fill the memory.
        """
        if size > _PACKET:
            raise EOFError(f'a packet of {size} bytes')
        return super().recv(size, flags)


class ProxySocket(PacketSocket):
    """Our end of the streams of a program, which ends with it."""

    child: subprocess.Popen[bytes]
    _stuck_since: Optional[float] = None

    def send(self, data: Any, flags: int = 0) -> int:
        """
        Send what the program takes within the time-out.

        :raises TimeoutError: it takes nothing.
        :raises ConnectionAbortedError: it has taken nothing for ``STUCK`` seconds; a TCP
            connection would end, too.
        """
        now = time.monotonic()
        try:
            sent = super().send(data, flags)
        except TimeoutError:
            self._stuck_since = self._stuck_since or now
            if now - self._stuck_since > STUCK:
                raise ConnectionAbortedError(
                    errno.ECONNABORTED, 'the proxy takes nothing') from None
            raise
        self._stuck_since = None
        return sent

    def close(self) -> None:
        """End the program; a read in another thread returns b''."""
        with contextlib.suppress(OSError):
            self.shutdown(socket.SHUT_RDWR)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.child.pid, signal.SIGKILL)
        self.child.wait()
        super().close()

    def complaint(self) -> str:
        """Return the last line that a program wrote to standard error, after its end."""
        assert self.child.stderr is not None
        lines = self.child.stderr.read().decode(errors='replace').split('\n')
        return next((line.strip() for line in reversed(lines) if line.strip()), '')


def dial(command: Command, timeout: Optional[float]) -> ProxySocket:
    """
    Start a program, and return a socket whose other end is its standard input and output.

    :raises ConnectError: it cannot be started.
    """
    ours, theirs = socket.socketpair()
    with theirs:
        try:
            child = process.start(command, stdin=theirs.fileno(), stdout=theirs.fileno(),
                                  stderr=subprocess.PIPE)
        except OSError as error:
            ours.close()
            raise ConnectError(f"{command.argv[0]} can't be started: {error.strerror}") from error
    proxy = ProxySocket(ours.family, ours.type, fileno=ours.detach())
    proxy.child = child
    proxy.settimeout(timeout)
    return proxy
