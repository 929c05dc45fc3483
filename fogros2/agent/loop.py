# SPDX-License-Identifier: Apache-2.0
"""One thread that serves sockets and timers, and blocks on none of them."""

from __future__ import annotations

from collections.abc import Callable
import selectors
import socket
import time

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
