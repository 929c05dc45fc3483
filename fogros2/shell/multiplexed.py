# SPDX-License-Identifier: Apache-2.0
"""The robot's end of a machine's multiplexer: a connection and its channels."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import json
import select
import socket
import struct
import threading
import time
from typing import Optional

from fogros2.errors import ConnectError, FogError
from fogros2.model import Command
from fogros2.shell import flow
from fogros2.shell import multiplexer as mux

#: Seconds between two signs of life, and of silence after which the robot sends a ping.
ASK = 15.0


class Channel:
    """
    One command on the machine, with the interface of paramiko's Channel.

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
        self._window = flow.Window()
        #: Bytes that the machine may still send; each of two threads there exceeds by a chunk.
        self._room = self._window.size + 2 * mux.CHUNK
        #: Set when the exit status is known, or will never be known.
        self.status_event = threading.Event()

    # -- from the link --------------------------------------------------------------------------

    def take(self, kind: int, payload: bytes) -> None:
        """
        Process a frame from the multiplexer.

        :raises ValueError: it is none, or the machine sends more than it may.
        """
        with self._changed:
            if kind == mux.EXIT:
                self._status, = struct.unpack('>i', payload)
                self.status_event.set()
            elif kind == mux.WINDOW:
                self._credit += struct.unpack('>I', payload)[0]
            elif kind not in self._waiting:
                raise ValueError(f'a frame of kind {kind}')
            elif payload:
                self._room -= len(payload)
                if self._room < 0:
                    raise ValueError('more output than was asked for')
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
            owed = self._window.read(len(data), time.monotonic())
            self._room += owed
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
    A connection to a machine's multiplexer; thread-safe.

    :param connection: a socket to it; a subclass may have other ways to write and read.
    :param name: the machine's name, for messages.
    :param user: the login user.
    """

    def __init__(self, connection: socket.socket, name: str, user: str) -> None:
        self._socket = connection
        flow.keep_prompt(connection)
        self._name = name
        self._user = user
        self._lock = flow.Turns()
        self._channels: dict[int, Channel] = {}
        self._next = 1
        self._incoming = bytearray()
        self._error: Optional[FogError] = None
        self._closed = False
        threading.Thread(target=self._run, name='fog-link', daemon=True).start()

    def _write(self, data: bytes) -> None:
        """Send bytes to the multiplexer, with the lock held."""
        self._socket.sendall(data)

    def _read(self) -> bytes:
        """
        Return bytes that have arrived, with the lock held.

        :raises ConnectError: the multiplexer has ended.
        """
        data = self._socket.recv(1 << 18)
        if not data:
            raise ConnectError(f"'{self._name}' has closed the connection")
        return data

    def _errors(self) -> tuple[type[BaseException], ...]:
        """Return the errors of a lost connection."""
        return (OSError, ValueError, struct.error)

    def _pending(self) -> bool:
        """Return whether bytes have arrived that the socket no longer has."""
        return False

    def _ended(self) -> None:
        """Close the socket, after the last read."""
        self._socket.close()

    def is_alive(self) -> bool:
        """Return whether new commands can start."""
        return self._error is None

    def open(
        self, command: Optional[Command], terminal: Optional[tuple[int, int, str]] = None,
    ) -> Channel:
        """
        Start a command on the machine.

        :param command: None: the user's login shell.
        :param terminal: rows, columns and type of the command's terminal; None: no terminal.
        :raises ConnectError: the connection is lost.
        """
        command = command or Command(())
        what = {'argv': list(command.argv), 'env': dict(command.environment),
                'root': command.sudo, 'user': self._user, 'pty': terminal, 'credit': flow.LEAST}
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
        with self._using():
            self._write(mux.frame(kind, number, payload))

    @contextlib.contextmanager
    def _using(self) -> Iterator[None]:
        """Lock the connection; the first error ends the connection for all threads."""
        with self._lock:
            if self._error is not None:
                raise self._error
            try:
                yield
            except self._errors() as error:
                self._error = self._broken(error)
                self._wake()
                raise self._error from error

    def _broken(self, error: BaseException) -> ConnectError:
        return ConnectError(f"the connection to '{self._name}' was lost: {error}")

    def _wake(self) -> None:
        """Wake the reading thread, which closes the connection."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

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

    def _run(self) -> None:
        try:
            self._serve()
        except FogError as error:
            lost = error
        except self._errors() as error:
            lost = self._broken(error)
        self._lose(lost)
        with self._lock, contextlib.suppress(*self._errors()):
            self._ended()

    def _lose(self, error: FogError) -> None:
        with self._lock:
            self._error = self._error or error
            channels = list(self._channels.values())
            self._channels.clear()
        for channel in channels:
            channel.lose()

    def _serve(self) -> None:
        """
        Dispatch the multiplexer's frames to their channels.

        :raises ConnectError: the connection is lost or closed.
        """
        poll = select.poll()
        poll.register(self._socket, select.POLLIN)
        heard = told = time.monotonic()
        while True:
            for kind, number, payload in mux.frames(self._incoming):
                channel = self._channels.get(number)
                if channel is not None:
                    channel.take(kind, payload)
            if time.monotonic() - told >= ASK:
                # a machine that sends little hears nothing else; no answer may block its end
                self.send(mux.PONG, 0)
                told = time.monotonic()
            if not self._pending() and not poll.poll(ASK * 1000):
                if time.monotonic() - heard > 3 * ASK:
                    raise ConnectError(f"'{self._name}' has fallen silent")
                self.send(mux.PING, 0)
                continue
            # under the lock, because TLS has one state for reading and writing
            with self._using():
                self._incoming += self._read()
            heard = time.monotonic()
