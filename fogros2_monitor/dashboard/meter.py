# SPDX-License-Identifier: Apache-2.0
"""Measure messages and bytes per second of a topic, and decide when to subscribe; pure."""

from __future__ import annotations

from collections import deque
from typing import Optional

#: Window of a rate in seconds.
WINDOW = 5.0
#: Above LARGE bytes per second, the meter subscribes for TASTE seconds in each ROUND seconds,
#: because a topic of a machine crosses the VPN once more for the meter.
LARGE, TASTE, ROUND = 20_000.0, 1.0, 10.0


class Meter:
    """
    The rates of one topic; all times are seconds of one clock.

    :param now: time of the subscription.
    """

    def __init__(self, now: float) -> None:
        self._came: deque[tuple[float, int]] = deque()
        self._since = self._began = now
        self._listening = True
        self._rate: Optional[float] = None
        self._bandwidth: Optional[float] = None
        #: Whether the rate was measured only part of the time.
        self.sampled = False

    def heard(self, now: float, size: int) -> None:
        """Record a message of ``size`` bytes."""
        self._came.append((now, size))

    def wants(self, now: float) -> bool:
        """Return whether to subscribe now; call this a few times per second."""
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
            return  # too short: one message would change the rate too much
        self._rate = len(self._came) / span
        self._bandwidth = sum(size for _, size in self._came) / span
        if self._bandwidth <= LARGE:
            self.sampled = False

    def rates(self) -> tuple[Optional[float], Optional[float]]:
        """Return messages and bytes per second, None before the first second is over."""
        return self._rate, self._bandwidth
