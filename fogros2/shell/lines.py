# SPDX-License-Identifier: Apache-2.0
"""Read the output of programs on a machine line by line."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
from typing import Optional, TYPE_CHECKING, Union

from fogros2.errors import ConnectError, FogError
from fogros2.process import Tail
from fogros2.untrusted import DIGITS

if TYPE_CHECKING:
    import paramiko

    from fogros2.shell import multiplexed, proxy

#: Maximum bytes of a line, so that a machine cannot fill the robot's memory: JSON of empty lists
#: takes 40 times as much when it is parsed. An agent's longest messages are output of 64 K
#: characters.
MAX_LINE = 1 << 20
#: Maximum bytes that a command's standard output and standard error keep each; the oldest go.
KEPT = 4 << 20
_CHUNK = 1 << 16
#: A program on a machine. Errors are OSErrors or FogErrors; a read that timed out raises
#: TimeoutError.
Channel = Union['paramiko.Channel', 'multiplexed.Channel']
#: What carries lines: a channel, or a program of this computer.
Lines = Union[Channel, 'proxy.ProxySocket']


def take_errors(channel: Channel) -> bytes:
    """Return the standard error that has arrived; unread, it would stop the program."""
    parts = []
    while channel.recv_stderr_ready():
        parts.append(channel.recv_stderr(1 << 16))
    return b''.join(parts)


def close(channel: Lines) -> None:
    """Close a channel, whose connection may be gone."""
    # paramiko sends a message for it
    with contextlib.suppress(OSError):
        channel.close()


class LineStream:
    """
    Standard input and output of a program on a machine, line by line.

    :param name: the machine's name, for messages.
    """

    def __init__(self, channel: Lines, name: str) -> None:
        self._channel = channel
        self._name = name
        self._buffer = b''

    def write(self, data: bytes) -> None:
        """Send bytes to the program's standard input."""
        try:
            self._channel.sendall(data)
        except OSError as error:
            # the error for a program that ends meanwhile has no text
            why = str(error) or 'it ended'
            raise ConnectError(f"the connection to '{self._name}' is gone: {why}") from error

    def readline(self) -> bytes:
        """Return the next line of output with its newline, b'' at the end."""
        parts = [self._buffer]
        size = len(self._buffer)
        while b'\n' not in parts[-1]:
            if size > MAX_LINE:
                self.close()
                self._buffer = b''
                return b''
            data = b''
            with contextlib.suppress(OSError, FogError):
                data = self._channel.recv(_CHUNK)
            if not data:
                self._buffer = b''
                return b''.join(parts)
            parts.append(data)
            size += len(data)
        line, _, self._buffer = b''.join(parts).partition(b'\n')
        return line + b'\n'

    def close(self) -> None:
        """End the program; a ``readline`` in another thread returns b''."""
        close(self._channel)


class Output:
    """
    Collect a command's output, and pass complete lines on.

    :param on_output: callback for each line of standard output.
    :param announced: the first line is not output, but the command's process id.
    """

    def __init__(
        self, on_output: Optional[Callable[[str], None]], *, announced: bool = False,
    ) -> None:
        #: Process id that the command announced, 0 if it is unknown.
        self.pid = 0
        self._head: Optional[bytes] = b'' if announced else None
        self._on_output = on_output
        self._out, self._err = Tail(KEPT), Tail(KEPT)
        self._rest = b''

    def add(self, out: bytes = b'', err: bytes = b'') -> None:
        """Add new standard output and standard error."""
        if self._head is not None:
            first, newline, out = (self._head + out).partition(b'\n')
            # the machine may send anything: a first line without an end, a number without one
            self._head = None if newline else first[:DIGITS + 1]
            if newline and first.isdigit() and len(first) <= DIGITS:
                self.pid = int(first)
        self._out.add(out)
        self._err.add(err)
        if self._on_output is not None and out:
            *lines, self._rest = (self._rest + out).split(b'\n')
            if len(self._rest) > MAX_LINE:
                lines.append(self._rest)
                self._rest = b''
            for line in lines:
                self._on_output(line.decode(errors='replace'))

    def text(self) -> tuple[str, str]:
        """Return standard output and standard error; pass an incomplete last line on."""
        if self._on_output is not None and self._rest:
            self._on_output(self._rest.decode(errors='replace'))
            self._rest = b''
        return self._out.text(), self._err.text()
