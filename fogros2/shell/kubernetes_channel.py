# SPDX-License-Identifier: Apache-2.0
"""Hold the robot's state of one command in a pod: its output, its input window, its exit."""

from __future__ import annotations

import struct
import threading
from typing import Optional, Protocol

from fogros2.errors import FogError
from fogros2.shell import kubernetes_mux as mux


class Sender(Protocol):
    """The sender of a channel's frames."""

    def send(self, kind: int, number: int, payload: bytes = b'', /) -> None:
        """Send a frame; raise ConnectError if the connection is lost."""

    def forget(self, number: int, /) -> None:
        """Close a command's channel."""


class Channel:
    """One command in the pod, with the used methods of paramiko's Channel."""

    def __init__(self, link: Sender, number: int) -> None:
        self._link = link
        self._number = number
        self._changed = threading.Condition()
        self._waiting = {mux.OUT: bytearray(), mux.ERR: bytearray()}
        self._open = {mux.OUT, mux.ERR}
        self._status: Optional[int] = None
        self._credit = mux.CREDIT
        self._owed = 0
        self._closed = False
        self._lost: Optional[FogError] = None

    # -- from the link --------------------------------------------------------------------------

    def take(self, kind: int, payload: bytes) -> None:
        """Process a frame from the pod."""
        with self._changed:
            if kind == mux.EXIT:
                self._status, = struct.unpack('>i', payload)
            elif kind == mux.WINDOW:
                self._credit += struct.unpack('>I', payload)[0]
            elif payload:
                self._waiting[kind] += payload
            else:
                self._open.discard(kind)
            self._changed.notify_all()

    def lose(self, error: FogError) -> None:
        """Record that the connection is lost, so that no more frames will arrive."""
        with self._changed:
            self._lost = error
            self._changed.notify_all()

    # -- for its user ----------------------------------------------------------------------------

    @property
    def exit_status(self) -> Optional[int]:
        """The command's exit status, None while it runs."""
        return self._status

    def read(self, timeout: Optional[float]) -> tuple[bytes, bytes, bool]:
        """
        Wait for output; return standard output, standard error, and whether both have ended.

        :param timeout: seconds to wait; None: no time-out.
        :raises ConnectError: the connection is lost, and all earlier output was returned.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: any(self._waiting.values()) or not self._open or self._over(), timeout)
            out, err = (self._pop(kind, 0) for kind in (mux.OUT, mux.ERR))
            if not out and not err and self._lost is not None:
                raise self._lost
            ended = not self._open
        self._pay(len(out) + len(err))
        return out, err, ended

    def recv(self, size: int) -> bytes:
        """Return up to ``size`` bytes of standard output, b'' at its end."""
        return self._receive(mux.OUT, size)

    def recv_stderr(self, size: int) -> bytes:
        """Return up to ``size`` bytes of standard error, b'' at its end."""
        return self._receive(mux.ERR, size)

    def _receive(self, kind: int, size: int) -> bytes:
        with self._changed:
            self._changed.wait_for(
                lambda: self._waiting[kind] or kind not in self._open or self._over())
            data = self._pop(kind, size)
        self._pay(len(data))
        return data

    def discard_errors(self) -> None:
        """Discard standard error; unread output would fill the window and stop the program."""
        with self._changed:
            size = len(self._pop(mux.ERR, 0))
        self._pay(size)

    def _pop(self, kind: int, size: int) -> bytes:
        waiting = self._waiting[kind]
        data = bytes(waiting[:size] if size else waiting)
        del waiting[:len(data)]
        return data

    def _pay(self, size: int) -> None:
        self._owed += size
        if self._owed >= mux.CREDIT // 4:
            owed, self._owed = self._owed, 0
            self._link.send(mux.WINDOW, self._number, struct.pack('>I', owed))

    def _over(self) -> bool:
        return self._closed or self._lost is not None

    def wait_exit(self, timeout: float) -> bool:
        """Wait up to ``timeout`` seconds; return whether the command exited or is lost."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._status is not None or self._over(), timeout)

    def recv_exit_status(self) -> int:
        """Wait for the exit, and return the exit status; -1 if it will never be known."""
        with self._changed:
            self._changed.wait_for(lambda: self._status is not None or self._over())
            return -1 if self._status is None else self._status

    def sendall(self, data: bytes) -> None:
        """
        Send to standard input, as fast as the command reads.

        :raises OSError: the command has ended, or the channel is lost or closed.
        """
        rest = memoryview(data)
        while rest:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._credit > 0 or self._status is not None or self._over())
                if self._over() or self._status is not None:
                    raise BrokenPipeError('the command has ended')
                piece = bytes(rest[:min(mux.CHUNK, self._credit)])
                self._credit -= len(piece)
            self._link.send(mux.IN, self._number, piece)
            rest = rest[len(piece):]

    def shutdown_write(self) -> None:
        """Close the command's standard input."""
        self._link.send(mux.IN, self._number)

    def resize_pty(self, columns: int, rows: int) -> None:
        """Send the terminal's new size."""
        self._link.send(mux.RESIZE, self._number, struct.pack('>HH', rows, columns))

    def settimeout(self, timeout: Optional[float]) -> None:
        """Do nothing; the method exists for paramiko's interface."""

    def close(self) -> None:
        """Close the channel, which ends a running command."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        self._link.forget(self._number)
