# SPDX-License-Identifier: Apache-2.0
"""A connection through a program: OpenSSH's ``ProxyCommand`` and ``ProxyJump``."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import os
import signal
import socket
import subprocess

from fogros2 import process
from fogros2.errors import ConnectError
from fogros2.model import Command


class ProxySocket(socket.socket):
    """Our end of the streams of a program, which ends with it."""

    child: subprocess.Popen[bytes]

    def close(self) -> None:
        """Close the streams, and end the program."""
        super().close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.child.pid, signal.SIGKILL)
        self.child.wait()

    def complaint(self) -> str:
        """Return the last line that a program wrote to standard error, after its end."""
        assert self.child.stderr is not None
        lines = self.child.stderr.read().decode(errors='replace').split('\n')
        return next((line.strip() for line in reversed(lines) if line.strip()), '')


def dial(words: Sequence[str], timeout: float) -> ProxySocket:
    """
    Start a program, and return a socket whose other end is its standard input and output.

    :raises ConnectError: it cannot be started.
    """
    ours, theirs = socket.socketpair()
    with theirs:
        try:
            child = process.start(Command(tuple(words)), stdin=theirs.fileno(),
                                  stdout=theirs.fileno(), stderr=subprocess.PIPE)
        except OSError as error:
            ours.close()
            raise ConnectError(f"{words[0]} can't be started: {error.strerror}") from error
    proxy = ProxySocket(ours.family, ours.type, fileno=ours.detach())
    proxy.child = child
    proxy.settimeout(timeout)
    return proxy
