# SPDX-License-Identifier: Apache-2.0
"""Read a remote program's output line by line, over any kind of channel."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
from typing import Optional, Protocol

from fogros2.errors import ConnectError, FogError

#: Maximum bytes of a line, so that a machine cannot fill the robot's memory.
MAX_LINE = 32 << 20
_CHUNK = 1 << 16


class Channel(Protocol):
    """A shell's channel to a program; its errors are OSErrors or FogErrors."""

    def recv(self, size: int, /) -> bytes:
        """Wait for standard output, and return up to ``size`` bytes; b'' at the end."""

    def sendall(self, data: bytes, /) -> None:
        """Send to standard input, as fast as the program reads."""

    def close(self) -> None:
        """Close the channel, which ends a running program."""


class LineStream:
    """
    Standard input and output of a program on a machine, line by line.

    :param name: the machine's name, for messages.
    :param discard_errors: callback that discards standard error; unread output would fill the
        channel's window and stop the program.
    """

    def __init__(self, channel: Channel, name: str, discard_errors: Callable[[], object]) -> None:
        self._channel = channel
        self._name = name
        self._discard_errors = discard_errors
        self._buffer = b''

    def write(self, data: bytes) -> None:
        """Send bytes to the program's standard input."""
        try:
            self._channel.sendall(data)
        except (OSError, EOFError) as error:
            # paramiko's error for a program that ends meanwhile has no text.
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
                self._discard_errors()
            if not data:
                self._buffer = b''
                return b''.join(parts)
            parts.append(data)
            size += len(data)
        line, _, self._buffer = b''.join(parts).partition(b'\n')
        return line + b'\n'

    def close(self) -> None:
        """End the program; a ``readline`` in another thread returns b''."""
        self._channel.close()


class Output:
    """
    Collect a command's output, and pass complete lines on.

    :param on_output: callback for each line of standard output.
    """

    def __init__(self, on_output: Optional[Callable[[str], None]]) -> None:
        self._on_output = on_output
        self._out: list[bytes] = []
        self._err: list[bytes] = []
        self._rest = b''

    def add(self, out: bytes = b'', err: bytes = b'') -> None:
        """Add new standard output and standard error."""
        self._out.append(out)
        self._err.append(err)
        if self._on_output is not None and out:
            *lines, self._rest = (self._rest + out).split(b'\n')
            for line in lines:
                self._on_output(line.decode(errors='replace'))

    def text(self) -> tuple[str, str]:
        """Return standard output and standard error; pass an incomplete last line on."""
        if self._on_output is not None and self._rest:
            self._on_output(self._rest.decode(errors='replace'))
            self._rest = b''
        return (b''.join(self._out).decode(errors='replace'),
                b''.join(self._err).decode(errors='replace'))
