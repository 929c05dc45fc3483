# SPDX-License-Identifier: Apache-2.0
"""Messages and bytes per second of a topic, and when to listen to it; pure but for the clock."""

from __future__ import annotations

from collections import deque
from typing import Optional

#: Seconds over which a rate is taken.
WINDOW = 5.0
#: Bytes per second from which on a topic is listened to for ``TASTE`` seconds in each ``ROUND``:
#: one that comes from a machine crosses the VPN once more for us.
LARGE, TASTE, ROUND = 20_000.0, 1.0, 10.0


class Meter:
    """
    One topic's rates; times are those of one clock, in seconds.

    :param now: from when on it is listened to.
    """

    def __init__(self, now: float) -> None:
        self._came: deque[tuple[float, int]] = deque()
        self._since = self._began = now
        self._listening = True
        self._rate: Optional[float] = None
        self._bandwidth: Optional[float] = None
        #: Whether the rate was measured for a part of the time only.
        self.sampled = False

    def heard(self, now: float, size: int) -> None:
        """Note a message of so many bytes."""
        self._came.append((now, size))

    def wants(self, now: float) -> bool:
        """Return whether to listen now; to be asked a few times a second."""
        seconds = now - self._since
        if self._listening:
            self._measure(now, seconds)
            if seconds >= TASTE and (self._bandwidth or 0.0) > LARGE:
                self.sampled, self._listening = True, False
                self._came.clear()
        elif now - self._began >= ROUND:
            self._listening, self._since, self._began = True, now, now
        return self._listening

    def _measure(self, now: float, seconds: float) -> None:
        while self._came and self._came[0][0] < now - WINDOW:
            self._came.popleft()
        span = min(seconds, WINDOW)
        if span < TASTE:
            return  # a message more or less would make too much of a difference
        self._rate = len(self._came) / span
        self._bandwidth = sum(size for _, size in self._came) / span
        if self._bandwidth <= LARGE:
            self.sampled = False

    def rates(self) -> tuple[Optional[float], Optional[float]]:
        """Return messages and bytes per second, None before the first second is over."""
        return self._rate, self._bandwidth
