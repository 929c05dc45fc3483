# SPDX-License-Identifier: Apache-2.0
"""One thread that serves sockets and timers, and blocks on none of them."""

from __future__ import annotations

from collections.abc import Callable
import selectors
import socket
import time

from fogros2.agent.journal import BLOCK

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, Optional


def boot_clock() -> float:
    """Return seconds since boot, including suspended time."""
    return time.clock_gettime(getattr(time, 'CLOCK_BOOTTIME', time.CLOCK_MONOTONIC))


class Timer:
    """A delayed callback; setting ``at`` to None cancels it."""

    def __init__(self, at: float, call: Callable[[], None]) -> None:
        self.at: Optional[float] = at
        self.call = call


class Loop:
    """
    Call functions when a socket is ready or a time has come.

    :param clock: returns monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = boot_clock) -> None:
        self.clock = clock
        self.selector = selectors.DefaultSelector()
        self.timers: list[Timer] = []

    def at(self, delay: float, call: Callable[[], None]) -> Timer:
        """Call a function in ``delay`` seconds."""
        timer = Timer(self.clock() + delay, call)
        self.timers.append(timer)
        return timer

    def select(
        self, connection: socket.socket | int, events: int, call: Callable[[int], Any],
    ) -> None:
        """Call a function with the ready events of a socket or descriptor that are ``wanted``."""
        key = self.selector.get_map().get(connection)
        if not events:
            if key is not None:
                self.selector.unregister(connection)
        elif key is None:
            self.selector.register(connection, events, call)
        elif key.events != events:
            self.selector.modify(connection, events, call)

    def turn(self, until: float) -> None:
        """Wait for a socket, a timer or the time ``until``; make the calls that are due."""
        soonest = min([until, *(timer.at for timer in self.timers if timer.at is not None)])
        for key, mask in self.selector.select(min(60.0, max(0.0, soonest - self.clock()))):
            key.data(mask)
        now = self.clock()
        due = [timer for timer in self.timers if timer.at is not None and timer.at <= now]
        self.timers = [t for t in self.timers if t.at is not None and t.at > now]
        for timer in due:
            if timer.at is not None:
                timer.call()


class Channel:
    """
    A socket that exchanges lines without blocking.

    :param take: called with received lines.
    """

    def __init__(
        self, loop: Loop, connection: socket.socket, take: Callable[[list[bytes]], None],
    ) -> None:
        connection.setblocking(False)
        self.loop = loop
        self.socket = connection
        self.take = take
        self.received = bytearray()
        self.out = bytearray()
        #: Whether the other end sends nothing more.
        self.ended = False
        #: Whether ``send`` has more to send than ``out``.
        self.more = False
        loop.select(connection, selectors.EVENT_READ, self.serve)

    def send(self, data: bytes = b'') -> None:
        """Send data as far as the other end takes it now, the rest later."""
        self.out += data
        try:
            while self.out:
                del self.out[:self.socket.send(self.out[:BLOCK])]
        except BlockingIOError:
            pass
        except OSError:
            self.broken()
            return
        self.wait()

    def broken(self) -> None:
        """Give up sending: the other end has closed the connection."""
        self.out.clear()
        self.wait()

    def wait(self) -> None:
        """Wait for data, and until the other end takes the rest of the output."""
        # a socket at its end would wake the selector forever
        events = 0 if self.ended else selectors.EVENT_READ
        if self.out or self.more:
            events |= selectors.EVENT_WRITE
        self.loop.select(self.socket, events, self.serve)

    def receive(self) -> bool:
        """Read once, and handle the whole lines; return whether there may be more."""
        try:
            data = self.socket.recv(BLOCK)
        except BlockingIOError:
            return False
        except OSError:
            data = b''
        self.ended = not data
        self.received += data
        *lines, self.received = self.received.split(b'\n')
        self.take([bytes(line) for line in lines if line.strip()])
        return bool(data)

    def serve(self, mask: int) -> None:
        """Exchange data with the other end when the socket is ready."""
        if mask & selectors.EVENT_READ:
            self.receive()
        self.send()

    def close(self) -> None:
        """Close the socket."""
        self.loop.select(self.socket, 0, self.serve)
        self.socket.close()
