# SPDX-License-Identifier: Apache-2.0
"""
Adapt clouds to the links of all receivers: resolution, rate.

If a cloud is on its way for most of the time until the next one, the resolution becomes coarser,
by as many bits as the link lacks.
The rate falls by itself: of the clouds that come while one is sent, only the newest is kept.
"""

from __future__ import annotations

from collections import deque
from typing import Optional

from point_cloud_stream.codec import Coded

#: Coarsest resolution in metres that a thin link leads to.
COARSEST = 0.2
#: Shares of the time between clouds: above BUSY the resolution becomes coarser, such that a cloud
#: takes AIM; it becomes finer if a cloud would still take less than AIM.
BUSY, AIM = 0.85, 0.6
#: Clouds in a row that took too long, or their seconds; a busy processor delays some, a thin link
#: all of them.
IN_A_ROW, SECONDS_IN_A_ROW = 3, 0.6
#: Seconds until the resolution becomes finer, and the factor.
CALM, FINER = 1.0, 0.5
#: Most bits of a number to give up at once.
MOST_BITS = 4.0


class Control:
    """
    Choose resolution and rate; times are seconds of one clock.

    :param asked: the user's resolution in metres; 0 for lossless clouds, whose rate adapts alone.
    :param max_rate: maximum clouds per second, 0: no limit.
    """

    def __init__(self, asked: float, max_rate: float = 0.0) -> None:
        self.asked = self.resolution = asked
        self._shortest = 1 / max_rate if max_rate else 0.0
        self._interval = 0.1
        self._arrived: Optional[float] = None
        self._next_due = -1e9
        self._recent: deque[float] = deque(maxlen=IN_A_ROW)
        self._calm_since = -1e9
        #: Seconds of the last cloud from the encoder to the slowest decoder.
        self.latency = 0.0

    def arrived(self, now: float) -> bool:
        """Record that a cloud has arrived from the publisher; return whether to send it."""
        if self._arrived is not None:
            self._interval += 0.2 * (min(now - self._arrived, 1.0) - self._interval)
        self._arrived = now
        # Clouds have jitter: one that is early by less than half an interval is on time.
        if now < self._next_due - 0.5 * self._interval:
            return False
        self._next_due = max(self._next_due + self._shortest, now)
        return True

    def crossed(self, coded: Coded, seconds: float, quickest: float, now: float) -> None:
        """
        Adapt the resolution to the seconds that a cloud took to the slowest receiver and back.

        :param quickest: seconds of the quickest recent slice.
        """
        self.latency = seconds - quickest / 2
        took = max(seconds - quickest, 1e-3)
        if coded.resolution != self.resolution:
            return
        interval = max(self._interval, self._shortest)
        size, numbers = len(coded.data), coded.numbers
        if took > BUSY * interval:
            self._recent.append(took)
            self._calm_since = now
            enough = len(self._recent) == IN_A_ROW or sum(self._recent) > SECONDS_IN_A_ROW
            if enough and numbers:
                bits = 8 * size * (1 - AIM * interval / min(self._recent)) / numbers
                coarser = self.resolution * 2 ** min(bits, MOST_BITS)
                self.resolution = min(max(COARSEST, self.asked), coarser)
                self._recent.clear()
            return
        self._recent.clear()
        finer = max(self.asked, self.resolution * FINER)
        # it takes a bit more for each number
        fits = took * (1 + numbers / 8 / size) < AIM * interval
        if fits and finer < self.resolution and now - self._calm_since > CALM:
            self._calm_since = now
            self.resolution = finer
