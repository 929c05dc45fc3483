# SPDX-License-Identifier: Apache-2.0
r"""
Carry the datagrams of a WireGuard interface in a stream of bytes, at both of its ends.

The robot has one end, and sends the source to the machine, which runs it as the other. So it uses
only the standard library. At its host's loopback, each end exchanges datagrams with the interface.

A line of the stream is a letter and a text, in which ``\e`` is a backslash and ``\n`` a newline:
about 1 % more bytes. ``d`` has a datagram, ``c`` the number of bytes of lines with datagrams that
have arrived so far. An end sends no more than its :class:`Window` admits before it gets these
numbers. Its datagrams wait in a :class:`Queue`, where new ones displace the oldest.
"""

from __future__ import annotations

from collections import deque
import contextlib
import os
import socket
import sys
import threading
import time

TYPE_CHECKING = False  # importing it from typing would take the machine a while
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

#: Seconds for which what is under way may wait in the buffers of systems, programs and networks.
DELAY = 0.05
#: Bytes that are always admitted: some datagrams.
LEAST = 6000
#: Seconds after which the round trip without waiting is measured again.
MEMORY = 10.0
#: The share of a new measurement in the rate.
SHARE = 0.25
#: Bytes that may wait at least, and seconds of the rate.
LEAST_QUEUE, QUEUE = 1 << 16, 0.2
#: Bytes of datagrams in one write, so that numbers of bytes get their turn.
PIECE = 1 << 14
#: Bytes that the kernel keeps of datagrams from the interface.
BUFFER = 1 << 20
#: The first line of the machine's end.
READY = b'ready\n'
#: Errors of a stream that has ended; the robot's shells raise RuntimeErrors.
ENDED = (OSError, ValueError, RuntimeError)


def line(data: bytes) -> bytes:
    """Return the line with a datagram."""
    return b'd%s\n' % data.replace(b'\\', b'\\e').replace(b'\n', b'\\n')


def datagram(text: bytes) -> bytes:
    """Return the datagram of a line without its letter and its newline."""
    return text.replace(b'\\n', b'\n').replace(b'\\e', b'\\')


def datagrams(link: socket.socket) -> Iterator[bytes]:
    """Yield what comes to a connected socket until it is shut down."""
    while True:
        try:
            data, sender = link.recvfrom(1 << 16)
        except ConnectionRefusedError:
            continue  # an interface is being repaired
        except OSError:
            return
        if sender is None:
            return
        yield data


class Window:
    """
    How many bytes may be under way: those of a round trip, and ``DELAY`` at the measured rate.

    It starts with ``LEAST``, and doubles each round trip until bytes wait. Times are seconds of a
    monotonic clock.

    :ivar rate: bytes per second that arrive when there is enough to send, 0 before it is known.
    :ivar heard: when bytes last arrived, or were sent while none were under way.
    """

    def __init__(self) -> None:
        self.rate = 0.0
        self.heard = 0.0
        self._limit = float(LEAST)
        self._starting = True
        self._sent = self._arrived = 0
        #: Of what is under way: the number of its last byte, when it was sent, the bytes that had
        #: arrived by then, and whether more was waiting.
        self._under_way: deque[tuple[int, float, int, bool]] = deque()
        #: The shortest round trips of this period and of the one before; when this one began.
        self._shortest = self._former = float('inf')
        self._began = float('-inf')
        #: Since when little is sent, so that nothing waits and the round trip can be measured.
        self._draining = float('inf')

    @property
    def under_way(self) -> int:
        """The bytes that have been sent and have not arrived, as far as is known."""
        return self._sent - self._arrived

    def admits(self) -> bool:
        """Return whether more may be sent."""
        if self._draining < float('inf'):
            # less than the round trip alone takes, so that nothing waits
            return self.under_way < max(LEAST, 0.9 * self.rate * self._former)
        return self.under_way < self._limit

    def sent(self, count: int, now: float, *, more: bool) -> None:
        """
        Record what was sent.

        :param more: whether more is waiting.
        """
        if not self._under_way:
            self.heard = now
        self._sent += count
        self._under_way.append((self._sent, now, self._arrived, self._draining == float('inf')
                                and (more or not self.admits())))

    def arrived(self, total: int, now: float) -> None:
        """Record how many bytes have arrived in all."""
        last = None
        while self._under_way and self._under_way[0][0] <= total:
            last = self._under_way.popleft()
        if last is None:
            return
        number, when, before, limited = last
        round_trip = max(now - when, 1e-4)
        count, self._arrived, self.heard = number - self._arrived, number, now
        self._measure(round_trip, when, now)
        rate = (number - before) / round_trip
        if limited or rate > self.rate:
            self.rate += (rate - self.rate) * (SHARE if self.rate else 1.0)
        shortest = min(self._shortest, self._former)
        self._starting = self._starting and round_trip <= shortest + DELAY
        if not self._starting:
            self._limit = max(LEAST, self.rate * (shortest + DELAY))
        elif limited:
            self._limit += count

    def _measure(self, round_trip: float, when: float, now: float) -> None:
        """Note a round trip; drain when the shortest one may have grown."""
        if when >= self._draining:
            self._draining = float('inf')
            self._shortest = self._former = round_trip
        self._shortest = min(self._shortest, round_trip)
        if now - self._began > MEMORY:
            if self._shortest > self._former + DELAY / 5:
                self._draining = now
            else:
                self._former, self._shortest = self._shortest, float('inf')
            self._began = now


class Queue:
    """Datagrams that wait; new ones displace the oldest."""

    def __init__(self) -> None:
        self._waiting: deque[bytes] = deque()
        self._size = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, data: bytes, rate: float) -> None:
        """
        Add a datagram.

        :param rate: bytes per second at which they are sent.
        """
        self._waiting.append(data)
        self._size += len(data)
        while self._size > max(LEAST_QUEUE, rate * QUEUE):
            self.take()

    def take(self) -> bytes:
        """Return the oldest datagram."""
        data = self._waiting.popleft()
        self._size -= len(data)
        return data


class Carrier:
    """
    One end of the stream.

    :param port: UDP port of the interface on this host.
    :param write: sends bytes into the stream; raises one of ``ENDED`` if it has ended.
    :param readline: returns the next line of the stream, b'' after its end.
    :param copy: called with each datagram of the interface before the datagram is sent.
    """

    def __init__(
        self, port: int, write: Callable[[bytes], object], readline: Callable[[], bytes],
        copy: Callable[[bytes], object] = lambda data: None,
    ) -> None:
        self._write, self._readline, self._copy = write, readline, copy
        self.window = Window()
        self.queue = Queue()
        self._changed = threading.Condition()
        #: Bytes that have arrived here, and those of them that the other end knows of.
        self._received = self._told = 0
        self.over = False
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        self._link.bind(('127.0.0.1', 0))
        # nothing else on this host can send here
        self._link.connect(('127.0.0.1', port))
        #: Where the interface finds the other end.
        self.address = self._link.getsockname()

    def run(self) -> None:
        """Carry datagrams until the stream ends."""
        threads = [threading.Thread(target=work, name='fog-carry', daemon=True)
                   for work in (self._take, self._send)]
        for thread in threads:
            thread.start()
        try:
            while not self.over and (text := self._readline()):
                self._arrive(text)
        except ENDED:
            pass
        finally:
            self.close()
            for thread in threads:
                thread.join(1.0)
            self._link.close()

    def close(self) -> None:
        """End; the stream is its owner's to close."""
        with self._changed:
            self.over = True
            self._changed.notify_all()
        with contextlib.suppress(OSError):
            self._link.shutdown(socket.SHUT_RDWR)

    def deliver(self, data: bytes) -> None:
        """Hand a datagram to the interface."""
        with contextlib.suppress(OSError):  # the interface is being repaired, or it is no datagram
            self._link.send(data)

    def _arrive(self, text: bytes) -> None:
        with self._changed:
            if text[:1] == b'c':
                self.window.arrived(int(text[1:]), time.monotonic())
            else:
                self._received += len(text)
            self._changed.notify_all()
        if text[:1] == b'd':
            self.deliver(datagram(text[1:-1]))

    def _take(self) -> None:
        for data in datagrams(self._link):
            self._copy(data)
            with self._changed:
                self.queue.add(data, self.window.rate)
                self._changed.notify_all()

    def _send(self) -> None:
        with contextlib.suppress(*ENDED):
            while not self.over:
                self._write(self._next())
        self.close()

    def _next(self) -> bytes:
        """Wait for something to send, and return it."""
        with self._changed:
            self._changed.wait_for(lambda: self.over or self._received > self._told or (
                self.queue and self.window.admits()))
            pieces, size = [], 0
            if self._received > self._told:
                self._told = self._received
                pieces.append(b'c%d\n' % self._told)
            while self.queue and size < PIECE and self.window.admits():
                pieces.append(line(self.queue.take()))
                size += len(pieces[-1])
                self.window.sent(len(pieces[-1]), time.monotonic(), more=bool(self.queue))
            return b''.join(pieces)


def write_all(data: bytes) -> None:
    """Write to standard output."""
    while data:
        data = data[os.write(1, data):]


if __name__ == '__main__':
    carrier = Carrier(int(sys.argv[1]), write_all, sys.stdin.buffer.readline)
    write_all(READY)
    carrier.run()
