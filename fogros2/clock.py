# SPDX-License-Identifier: Apache-2.0
"""
Read a server's clock; measure the offset of a machine's against the robot's, as NTP does.

The machine adds its time to the robot's message and returns it; that time lies between sending and
receiving: RFC 5905, sections 8 and 10.
"""

from __future__ import annotations

from collections import deque
import dataclasses
from email.utils import parsedate_to_datetime
import time
from typing import Optional

#: Offset in seconds above which a launch warns: TF and message filters tolerate a few frames.
LIMIT = 0.05
#: Number of round trips to compare; the shortest has the least uncertainty.
SAMPLES = 8


@dataclasses.dataclass(frozen=True)
class ClockOffset:
    """
    A machine's clock compared with the robot's clock.

    :param seconds: positive if the machine's clock is ahead.
    :param uncertainty: half the round trip in seconds: one direction may have taken nearly all.
    """

    seconds: float
    uncertainty: float

    @property
    def exceeds(self) -> bool:
        """Whether the offset exceeds the limit for any distribution of the round trip."""
        return abs(self.seconds) - self.uncertainty > LIMIT

    def contradicts(self, other: ClockOffset) -> bool:
        """Return whether the clock must have been changed between two measurements."""
        return abs(self.seconds - other.seconds) > self.uncertainty + other.uncertainty

    def __str__(self) -> str:
        bounds = f'± {_words(self.uncertainty)}'
        if abs(self.seconds) <= self.uncertainty:
            return f"the same as the robot's ({bounds})"
        side = 'ahead of' if self.seconds > 0 else 'behind'
        return f"{_words(abs(self.seconds))} {side} the robot's ({bounds})"


class OffsetFilter:
    """Select the best of the recent measurements."""

    def __init__(self) -> None:
        self._samples: deque[ClockOffset] = deque(maxlen=SAMPLES)

    def add(self, round_trip: float, here: float, there: float) -> ClockOffset:
        """
        Add a round trip, and return the best current measurement.

        :param round_trip: seconds, by a monotonic clock.
        :param here: the robot's time when the answer arrived, in seconds since the epoch.
        :param there: the machine's time in the answer, in seconds since the epoch.
        """
        sample = ClockOffset(there - (here - round_trip / 2), round_trip / 2)
        if any(sample.contradicts(other) for other in self._samples):
            # a clock was set: older measurements are invalid
            self._samples.clear()
        self._samples.append(sample)
        return min(reversed(self._samples), key=lambda one: one.uncertainty)


class ServerClock:
    """The clock of an HTTP server, which may be right where this computer's is wrong."""

    def __init__(self) -> None:
        self._last = ('', 0.0)

    def note(self, date: str) -> None:
        """Note the Date header of a response that has just come, '' if it has none."""
        self._last = date, time.monotonic()

    def now(self) -> float:
        """Return the time of the last response, continued; else that of this computer."""
        date, since = self._last
        try:
            return parsedate_to_datetime(date).timestamp() + time.monotonic() - since
        except (TypeError, ValueError):
            return time.time()


class OffsetAlarm:
    """Decide when to warn of an offset: once, and again after it was corrected."""

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
