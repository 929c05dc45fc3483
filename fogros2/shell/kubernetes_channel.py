# SPDX-License-Identifier: Apache-2.0
"""One command in a pod, as the robot sees it: what it has written, what it will still take."""

from __future__ import annotations

import struct
import threading
from typing import Optional, Protocol

from fogros2.errors import FogError
from fogros2.shell import kubernetes_mux as mux


class Sender(Protocol):
    """What a channel's frames go through."""

    def send(self, kind: int, number: int, payload: bytes = b'', /) -> None:
        """Send a frame, now or as soon as the connection is back."""

    def forget(self, number: int, /) -> None:
        """Let a command go."""


class Channel:
    """One command in the pod; the methods are those of paramiko's that are used here."""

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
        """Take a frame."""
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
        """Note that nothing more will come."""
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
        Wait for output, and return it: standard output, standard error, whether both have ended.

        :raises ConnectError: the pod was lost, and all that came before has been returned.
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
        """Return some of its standard output, b'' at the end."""
        return self._receive(mux.OUT, size)

    def recv_stderr(self, size: int) -> bytes:
        """Return some of its standard error, b'' at the end."""
        return self._receive(mux.ERR, size)

    def _receive(self, kind: int, size: int) -> bytes:
        with self._changed:
            self._changed.wait_for(
                lambda: self._waiting[kind] or kind not in self._open or self._over())
            data = self._pop(kind, size)
        self._pay(len(data))
        return data

    def discard_errors(self) -> None:
        """Drop what it wrote to standard error: unread, it would stop the program."""
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
        """Return whether the command has exited, or is lost, after so many seconds at most."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._status is not None or self._over(), timeout)

    def recv_exit_status(self) -> int:
        """Wait for it to exit and return its status; -1 if that is never to be known."""
        with self._changed:
            self._changed.wait_for(lambda: self._status is not None or self._over())
            return -1 if self._status is None else self._status

    def sendall(self, data: bytes) -> None:
        """
        Send to its standard input, as fast as it reads.

        :raises OSError: it is lost or closed.
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
        """End its standard input."""
        self._link.send(mux.IN, self._number)

    def resize_pty(self, columns: int, rows: int) -> None:
        """Tell it the terminal's size."""
        self._link.send(mux.RESIZE, self._number, struct.pack('>HH', rows, columns))

    def settimeout(self, timeout: Optional[float]) -> None:
        """Take the one that there is: none."""

    def close(self) -> None:
        """Let it go; it ends if it runs still."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        self._link.forget(self._number)
