# SPDX-License-Identifier: Apache-2.0
"""Adapt the encoder to the links of all receivers: bitrate, frame rate, error correction."""

from __future__ import annotations

from collections import deque
import dataclasses
import math
from typing import Optional

from image_transport_h264.rate import Governor, LEAST_BITRATE, LEAST_BITS, MOST_RECEIVERS
from image_transport_h264.settings import MAX_RATE, Settings

#: Seconds after which a silent receiver no longer limits the others.
SILENT = 3.0
#: Window of the stream's rate in seconds.
RATE_SECONDS = 1.0
#: Packets are repeated in pieces only if the bitrate is at least this multiple of the used rate.
ROOM = 2.0
#: A higher bitrate needs a new keyframe. It is worth one only if it is higher by the factor WORTH
#: and the stream uses the share BINDING of the current one.
WORTH, BINDING = 1.4, 0.5


class Control:
    """
    Adapt to all receivers; the slowest link decides.

    :param asked: the user's settings, kept if the links allow them.
    :param max_rate: maximum pictures per second, 0: no limit.
    :param adapt: False: apply only ``max_rate``.
    """

    def __init__(self, asked: Settings, max_rate: float = 0.0, adapt: bool = True) -> None:
        #: The stream's share of its links in bits per second.
        self.share = math.inf
        self._governors: dict[int, Governor] = {}
        self.ask(asked, max_rate, adapt)
        self._sent: deque[tuple[float, int]] = deque()
        self._interval = 1 / 30
        self._arrived: Optional[float] = None
        self._last_sent = self._next_due = -1e9

    @property
    def round_trip(self) -> float:
        """The recent minimum round trip of the slowest receiver in seconds; 0: unknown."""
        return max((governor.round_trip for governor in self._governors.values()), default=0.0)

    @property
    def latency(self) -> float:
        """The recent time of a packet to the slowest receiver in seconds; 0: unknown."""
        return max((governor.latency for governor in self._governors.values()), default=0.0)

    def ask(self, asked: Settings, max_rate: float, adapt: bool) -> None:
        """
        Set the user's settings from now on.

        :raises ValueError: ``max_rate`` is too large or negative.
        """
        if not MAX_RATE[0] <= max_rate <= MAX_RATE[1]:
            raise ValueError(f'max_rate {max_rate} is not between 0 and 1000')
        self.asked, self.max_rate, self.adapt = asked, max_rate, adapt
        for governor in self._governors.values():
            governor.ceiling = asked.bitrate
            governor.bitrate = min(governor.bitrate, governor.ceiling)

    def heard(self, receiver: int, sequence: int, lost: int, now: float) -> None:
        """Record an acknowledgement of a receiver."""
        governor = self._governors.get(receiver)
        if governor is None:
            if len(self._governors) == MOST_RECEIVERS:
                return
            governor = self._governors[receiver] = Governor(self.asked.bitrate)
        governor.acknowledged(sequence, lost, now)

    def due(self, now: float, pixels: int) -> bool:
        """Return whether to send the picture that has just arrived."""
        if self._arrived is not None:
            self._interval += 0.1 * (min(now - self._arrived, 1.0) - self._interval)
        self._arrived = now
        while self._sent and self._sent[0][0] < now - RATE_SECONDS:
            self._sent.popleft()
        if self.max_rate:
            # Pictures have jitter: one that is early by less than half an interval is on time.
            if now < self._next_due - 0.5 * self._interval:
                return False
            self._next_due = max(self._next_due + 1 / self.max_rate, now)
        for receiver in [receiver for receiver, governor in self._governors.items()
                         if (governor.heard or 0) < now - SILENT and len(self._governors) > 1]:
            del self._governors[receiver]
        # Ask every governor, because the call also makes a governor forget lost packets.
        # After a stall, images arrive in a burst, whose intervals are not their rate.
        since = max(now - self._last_sent, 0.9 * self._interval)
        fits = since * self.share >= 0.8 * LEAST_BITS * pixels or since > 1.0
        answers = [governor.may_send(now, pixels, since)
                   for governor in self._governors.values()]
        return fits and (all(answers) or not self.adapt)

    def settings(self, current: Settings, now: float) -> Settings:
        """
        Return the settings for the next picture; ``current`` if a change is not worth a keyframe.

        :param current: the settings of the last picture.
        """
        used = self._used()
        for governor in self._governors.values():
            governor.grow(now, used)
        wanted = self.asked.bitrate
        if self.adapt:
            wanted = min([wanted, *(g.bitrate for g in self._governors.values())])
        least = min(LEAST_BITRATE, self.asked.bitrate)
        wanted = int(max(least, min(wanted, self.share)))
        same = dataclasses.replace(
            self.asked, bitrate=current.bitrate, rate=current.rate) == current
        if same and wanted >= current.bitrate:
            more = wanted > WORTH * current.bitrate or wanted == self.asked.bitrate
            if wanted == current.bitrate or not more or used < BINDING * current.bitrate:
                return current
        elif same and wanted * WORTH > current.bitrate and used < BINDING * wanted:
            return current
        rate = min(1000.0, max(1.0, 1 / max(self._interval, 0.001)))
        return dataclasses.replace(self.asked, bitrate=wanted, rate=rate)

    def protects(self, now: float) -> bool:
        """Return whether to repeat packets in pieces: a link loses packets, and has room."""
        used = self._used() * ROOM
        return any(governor.loses(now) and used < min(governor.bitrate, self.share)
                   for governor in self._governors.values())

    def sent(self, sequence: int, size: int, now: float) -> None:
        """Record that a packet of ``size`` bytes, repetitions included, was sent."""
        self._last_sent = now
        self._sent.append((now, size * 8))
        for governor in self._governors.values():
            governor.sent(sequence, size, now)

    def _used(self) -> float:
        return sum(bits for _, bits in self._sent) / RATE_SECONDS
