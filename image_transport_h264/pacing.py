# SPDX-License-Identifier: Apache-2.0
"""
How many images may be under way at once, judged by how long their acknowledgements take.

An image that is sent while the link is still busy with the one before waits in the link's queue,
and where the queue is full, parts of it are lost. So the next image leaves when the last one is
acknowledged: one image under way fills a link whose round trip is short. On a long link most of
that time is the round trip, and more images fit: the window grows while they wait for nothing,
as TCP Vegas does (Brakmo and Peterson 1995, "End to end congestion avoidance on a global
internet").
"""

from __future__ import annotations

from collections import deque
import dataclasses

#: Images under way at the most; the publisher keeps as many, to repeat parts of them.
MOST = 8
#: Acknowledgements of a full window between two decisions: chance delays some, a queue all.
ROUND = 4
#: Images that wait in the link's queue: below the first the window grows, above the second it
#: shrinks.
FEW, MANY = 0.25, 0.75
#: Seconds over which the quickest acknowledgement counts.
MEMORY = 10.0
#: Seconds until a window that was too large is tried again, and the longest after it has been too
#: large several times in a row.
PATIENCE, MOST_PATIENCE = 5.0, 60.0


@dataclasses.dataclass(frozen=True)
class Sent:
    """An image under way: when it was sent (s), and as how many-th of those under way."""

    when: float
    place: int


class Pace:
    """The window of images under way; times are seconds of one clock that does not go back."""

    def __init__(self) -> None:
        self.window = 1
        self._under_way = 0
        self._trips: deque[tuple[float, float]] = deque()
        self._queued: list[float] = []
        self._patience = 0.0
        self._tried = -MOST_PATIENCE

    def may_send(self) -> bool:
        """Return whether there is room for another image."""
        return self._under_way < self.window

    def sent(self, now: float) -> Sent:
        """Note that an image leaves; pass the result to :meth:`acknowledged`."""
        self._under_way += 1
        return Sent(now, self._under_way)

    def acknowledged(self, sent: Sent, now: float) -> None:
        """Note that all readers have an image, and set the window."""
        self._under_way -= 1
        trip = max(now - sent.when, 1e-6)
        self._trips.append((now, trip))
        while self._trips[0][0] < now - MEMORY:
            self._trips.popleft()
        if sent.place < self.window:
            return  # the window did not hold this image up, so it says nothing about its size
        quickest = min(trip for _, trip in self._trips)
        self._queued.append(self.window * (1 - quickest / trip))
        if len(self._queued) < ROUND:
            return
        # a repeated fragment or a busy processor delays some images, a queue delays all
        queued = min(self._queued)
        self._queued.clear()
        if queued > MANY:
            self._shrink(self.window - 1, now)
        elif queued < FEW and self.window < MOST and now - self._tried >= self._patience:
            self.window += 1
        elif self.window > 1 and now - self._tried > 2 * self._patience:
            self._patience = 0.0

    def expired(self, now: float) -> None:
        """Note that an image was given up: the link is slow or gone, or a reader hangs."""
        self._under_way -= 1
        self._shrink(1, now)

    def _shrink(self, window: int, now: float) -> None:
        self.window = max(1, window)
        self._queued.clear()
        self._tried = now
        self._patience = min(MOST_PATIENCE, max(PATIENCE, 2 * self._patience))
