# SPDX-License-Identifier: Apache-2.0
"""Hold a machine's events until launch's event loop takes them, within a limit of memory."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
import sys
import threading
import time

from fogros2.events import Event

#: Maximum bytes of events that wait, and of one event beside its texts.
LIMIT, OVERHEAD = 32 << 20, 1000
#: Events that launch may have to process before it gets more, and seconds until the next look.
BUSY, PAUSE = 100, 0.01
#: Seconds between two reports of dropped output.
REPORT = 10.0


class Backlog:
    """
    Events in order; where they come faster than launch takes them, the oldest output is dropped.

    Other events are dropped only where no output waits: no honest machine has as many. The
    machine's nodes are never blocked.

    :param deliver: gets each event, on the event loop.
    :param busy: returns the number of events that launch has to process.
    :param dropped: gets a number of events that were dropped, now and then.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, deliver: Callable[[Event], None],
        busy: Callable[[], int], dropped: Callable[[int], None],
    ) -> None:
        self._loop, self._deliver, self._busy, self._dropped = loop, deliver, busy, dropped
        self._lock = threading.Lock()
        self._events: deque[Event] = deque()
        self._size = self._lost = 0
        self._scheduled = False
        self._reported = -REPORT

    def put(self, event: Event) -> None:
        """Add an event, from any thread; do nothing when launch's event loop is closed."""
        with self._lock:
            self._events.append(event)
            self._size += _size(event)
            while self._size > LIMIT:
                oldest = next((at for at, one in enumerate(self._events)
                               if one['event'] == 'output'), 0)
                self._size -= _size(self._events[oldest])
                del self._events[oldest]
                self._lost += 1
            if self._scheduled:
                return
            self._scheduled = True
        try:
            self._loop.call_soon_threadsafe(self._drain)
        except RuntimeError:
            return  # the launch's event loop is closed

    def _drain(self) -> None:
        waiting = True
        try:
            for _ in range(BUSY - self._busy()):
                event = self._next()
                if event is None:
                    waiting = False
                    break
                self._deliver(event)
        finally:
            if waiting:
                self._loop.call_later(PAUSE, self._drain)
        if self._lost and time.monotonic() - self._reported >= REPORT:
            self._reported = time.monotonic()
            with self._lock:
                lost, self._lost = self._lost, 0
            self._dropped(lost)

    def _next(self) -> Event | None:
        """Remove and return the oldest event; None if none waits, and the next one schedules."""
        with self._lock:
            if not self._events:
                self._scheduled = False
                return None
            event = self._events.popleft()
            self._size -= _size(event)
            return event


def _size(event: Event) -> int:
    return OVERHEAD + sum(sys.getsizeof(text) for text in event.values() if isinstance(text, str))
