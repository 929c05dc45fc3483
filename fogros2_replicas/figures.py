# SPDX-License-Identifier: Apache-2.0
"""Keep the figures of one replica, for one service or one output topic."""

from __future__ import annotations

from collections import deque
import math
import statistics
from typing import Any, Optional

#: Number of latencies that are kept, and how many of the last ones decide who is nearest.
WINDOW, NEAR = 200, 9
#: Number of latencies from which percentiles are meaningful.
ENOUGH = 20


class Figures:
    """The figures of one replica; all times are seconds of one clock."""

    def __init__(self, name: str) -> None:
        self.name = name
        #: Whether the ROS graph shows its end.
        self.there = False
        #: Whether its process has ended, as its agent or provider has reported.
        self.died = False
        #: Whether it has not answered in time, or far less often than others.
        self.late = self.slow = False
        self.won = self.failures = 0
        #: When each request without an answer was sent, in this order.
        self.sent: dict[int, float] = {}
        self.last = self.died_at = -math.inf
        self._latencies: deque[float] = deque(maxlen=WINDOW)

    @property
    def live(self) -> bool:
        """Whether it gets every request; otherwise it is left out."""
        return self.there and not (self.died or self.late or self.slow)

    @property
    def latency(self) -> Optional[float]:
        """The median of its last latencies in seconds, None before the first."""
        return statistics.median([*self._latencies][-NEAR:]) if self._latencies else None

    @property
    def p95(self) -> Optional[float]:
        """The 95th percentile of its latencies in seconds, None before there are enough."""
        if len(self._latencies) < ENOUGH:
            return None
        return statistics.quantiles(self._latencies, n=20)[-1]

    def took(self, seconds: float) -> None:
        """Record a latency."""
        self._latencies.append(seconds)

    def state(self) -> str:
        """Return its state in a word or two, for people."""
        return 'died' if self.died else 'absent' if not self.there else \
            'live' if self.live else 'left out'


def rows(name: str, replicas: list[Figures]) -> list[dict[str, Any]]:
    """Return the figures of all replicas of a service or a topic as JSON values."""
    total = sum(one.won for one in replicas)
    return [{
        'of': name, 'machine': one.name, 'state': one.state(), 'won': one.won,
        'share': one.won / total if total else None, 'failures': one.failures,
        'latency': None if one.latency is None else 1000 * one.latency,
        'p95': None if one.p95 is None else 1000 * one.p95} for one in replicas]
