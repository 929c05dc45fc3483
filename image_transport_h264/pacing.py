# SPDX-License-Identifier: Apache-2.0
"""
Limit the number of images in flight by the time of their acknowledgements.

An image that is sent while the link still sends the previous one waits in the link's queue. If
the queue is full, parts of the image are lost. So the next image is sent when the last one is
acknowledged: one image in flight fills a link with a short round trip. On a long link, more images
fit. The window grows while no image waits, as in TCP Vegas (Brakmo and Peterson 1995,
"End to end congestion avoidance on a global internet").
"""

from __future__ import annotations

from collections import deque
import dataclasses

#: Maximum images in flight; the publisher keeps as many, to repeat lost parts.
MOST = 8
#: Acknowledgements of a full window per decision; chance delays some of them, a queue all.
ROUND = 4
#: Number of images that wait in the link's queue: below FEW the window grows, above MANY it
#: shrinks, by default.
FEW, MANY = 0.25, 0.75
#: Seconds for which the quickest acknowledgement counts.
MEMORY = 10.0
#: Factor by which the quickest one of the others must be slower to send one image at a time again.
FORGOTTEN = 1.25
#: Seconds until a window that was too large is tried again; the pause doubles up to
#: MOST_PATIENCE if it is too large several times in a row.
PATIENCE, MOST_PATIENCE = 5.0, 60.0


@dataclasses.dataclass(frozen=True)
class Sent:
    """An image in flight: when it was sent (s), and its place among the images in flight."""

    when: float
    place: int


class Pace:
    """
    The window of images in flight; times are seconds of one monotonic clock.

    :param many: images in the link's queue above which the window shrinks.
    """

    def __init__(self, many: float = MANY) -> None:
        self._many = many
        self.window = 1
        self._under_way = 0
        self._trips: deque[tuple[float, float]] = deque()
        self._queued: list[float] = []
        self._patience = 0.0
        self._tried = -MOST_PATIENCE

    @property
    def quickest(self) -> float:
        """The recent minimum time until an acknowledgement in seconds; 0: unknown."""
        return min((trip for _, trip in self._trips), default=0.0)

    def may_send(self) -> bool:
        """Return whether the window has room for another image."""
        return self._under_way < self.window

    def sent(self, now: float) -> Sent:
        """Record that an image was sent; pass the result to :meth:`acknowledged`."""
        self._under_way += 1
        return Sent(now, self._under_way)

    def acknowledged(self, sent: Sent, now: float) -> None:
        """Record that all readers have an image, and adapt the window."""
        self._under_way -= 1
        trip = max(now - sent.when, 1e-6)
        self._trips.append((now, trip))
        known = self.quickest
        while self._trips[0][0] < now - MEMORY:
            self._trips.popleft()
        if self.window > 1 and self.quickest > FORGOTTEN * known:
            # only times with a queue are left: measure one without
            self.window = 1
            self._queued.clear()
            return
        if sent.place < self.window:
            return  # the window did not delay this image, so it says nothing about its size
        self._queued.append(self.window * (1 - self.quickest / trip))
        if len(self._queued) < ROUND:
            return
        # A repeated fragment or a busy processor delays some images, a queue delays all.
        queued = min(self._queued)
        self._queued.clear()
        if queued > self._many:
            self._shrink(self.window - 1, now)
        elif queued < FEW and self.window < MOST and now - self._tried >= self._patience:
            self.window += 1
        elif self.window > 1 and now - self._tried > 2 * self._patience:
            self._patience = 0.0

    def expired(self, now: float) -> None:
        """Record that an image was given up: the link is slow or gone, or a reader hangs."""
        self._under_way -= 1
        self._shrink(1, now)

    def _shrink(self, window: int, now: float) -> None:
        self.window = max(1, window)
        self._queued.clear()
        self._tried = now
        self._patience = min(MOST_PATIENCE, max(PATIENCE, 2 * self._patience))
