# SPDX-License-Identifier: Apache-2.0
"""
The offset of a machine's clock against the robot's, measured as NTP does.

A robot's message comes back with the machine's time in it, which was taken somewhere between
sending and receiving: RFC 5905, sections 8 and 10.
"""

from __future__ import annotations

from collections import deque
import dataclasses
from typing import Optional

#: Seconds of offset above which a launch warns: TF and message filters work to a few frames.
LIMIT = 0.05
#: Round trips that are compared; the shortest one has the least uncertainty.
SAMPLES = 8


@dataclasses.dataclass(frozen=True)
class ClockOffset:
    """
    A machine's clock compared with the robot's.

    :param seconds: positive where the machine's clock is ahead.
    :param uncertainty: seconds, half the round trip: each way may have taken nearly all of it.
    """

    seconds: float
    uncertainty: float

    @property
    def exceeds(self) -> bool:
        """Whether the offset is above the limit, whatever the ways took."""
        return abs(self.seconds) - self.uncertainty > LIMIT

    def contradicts(self, other: ClockOffset) -> bool:
        """Return whether a clock must have moved between two measurements."""
        return abs(self.seconds - other.seconds) > self.uncertainty + other.uncertainty

    def __str__(self) -> str:
        bounds = f'± {_words(self.uncertainty)}'
        if abs(self.seconds) <= self.uncertainty:
            return f"the same as the robot's ({bounds})"
        side = 'ahead of' if self.seconds > 0 else 'behind'
        return f"{_words(abs(self.seconds))} {side} the robot's ({bounds})"


class OffsetFilter:
    """Chooses the best of the last measurements."""

    def __init__(self) -> None:
        self._samples: deque[ClockOffset] = deque(maxlen=SAMPLES)

    def add(self, round_trip: float, here: float, there: float) -> ClockOffset:
        """
        Take a round trip and return the best measurement by now.

        :param round_trip: seconds, by a clock that nobody sets.
        :param here: the robot's time when the answer came, seconds since the epoch.
        :param there: the machine's time in the answer, seconds since the epoch.
        """
        sample = ClockOffset(there - (here - round_trip / 2), round_trip / 2)
        if any(sample.contradicts(other) for other in self._samples):
            # somebody set a clock: what was measured before is over
            self._samples.clear()
        self._samples.append(sample)
        return min(reversed(self._samples), key=lambda one: one.uncertainty)


class OffsetAlarm:
    """Decides when an offset is worth a warning: once, and again after it had been repaired."""

    def __init__(self) -> None:
        self._warned = False

    def due(self, offset: Optional[ClockOffset]) -> bool:
        """Return whether to warn now."""
        if offset is None:
            return False
        if abs(offset.seconds) < LIMIT / 2:
            self._warned = False
        if not offset.exceeds or self._warned:
            return False
        self._warned = True
        return True


def _words(seconds: float) -> str:
    return f'{seconds:.2f} s' if seconds >= 1 else f'{1000 * seconds:.1f} ms'
