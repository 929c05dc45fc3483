# SPDX-License-Identifier: Apache-2.0
"""
Keep a slow connection free for short messages: little of a long transfer is under way at once.

The channels of a connection share its TCP stream. What one of them has on the way, all others wait
for: 4 MB take half a minute at 1 Mbit/s.
"""

from __future__ import annotations

import contextlib
import socket
import threading

#: Bytes that a machine may send of a channel before they are read, at first and at the most.
LEAST, MOST = 1 << 15, 1 << 22
#: Seconds in which a window must arrive to be doubled; more than a round trip takes.
QUICK = 0.4
#: Bytes that a channel sends at once, while other channels wait.
PIECE = 1 << 14
#: Bytes that a connection holds unsent.
UNSENT = 1 << 14


class Window:
    """
    The bytes that a machine may send of a channel before they are read.

    The window doubles while its link carries all of it quickly.

    :ivar size: bytes.
    """

    def __init__(self) -> None:
        self.size = LEAST
        self._owed = self._arrived = 0
        self._began = float('-inf')

    def read(self, count: int, now: float) -> int:
        """
        Record that bytes were read; return how many more the machine may send now.

        :param now: seconds of a monotonic clock.
        """
        self._owed += count
        self._arrived += count
        if self._arrived >= self.size:
            if now - self._began < QUICK and self.size < MOST:
                self._owed += self.size
                self.size *= 2
            self._arrived, self._began = 0, now
        if self._owed <= self.size // 4:
            return 0
        owed, self._owed = self._owed, 0
        return owed


class Turns:
    """
    A lock that threads get in the order in which they ask.

    Of Python's own locks, the thread of a long transfer would take the next one, too.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._now = self._next = 0
        self._over: set[int] = set()

    def __enter__(self) -> None:
        with self._changed:
            mine, self._next = self._next, self._next + 1
            try:
                self._changed.wait_for(lambda: self._now == mine)
            except BaseException:
                self._over.add(mine)
                if self._now == mine:
                    self._pass_on()
                raise

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._over.add(self._now)
            self._pass_on()

    def _pass_on(self) -> None:
        while self._now in self._over:
            self._over.remove(self._now)
            self._now += 1
        self._changed.notify_all()


def keep_prompt(connection: socket.socket) -> None:
    """Let a TCP connection send short messages at once, and hold little that is not sent yet."""
    with contextlib.suppress(OSError):  # another kind of socket
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT)
