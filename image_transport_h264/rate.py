# SPDX-License-Identifier: Apache-2.0
"""
Estimate the capacity of a link by acknowledgements; lower first the bitrate, then the frame rate.

The sender records when each packet left; the receiver acknowledges each packet on arrival. A
packet's delay beyond the recent minimum and beyond its own time on the wire is time in a queue.
A lasting queue means that the sender exceeds the link's capacity. The bitrate then goes below the
rate of arrival, and no packet leaves until the queue is empty. Without acknowledgements (of a
subscriber that is not our decoder) the capacity is unknown, and there is no limit.
"""

from __future__ import annotations

from collections import deque
import dataclasses
from typing import Optional

#: Seconds of delay that count as a queue if all packets had it for QUEUE_SECONDS and for so many
#: acknowledgements. After a loss or a busy processor, at least one packet is quick.
QUEUE, QUEUE_SECONDS, QUEUE_ACKNOWLEDGEMENTS = 0.04, 0.3, 4
#: Seconds beyond the usual round trip after which new pictures are skipped. If no packet was
#: acknowledged for LOST seconds, a picture is sent every PROBE seconds: it shows the end of a cut.
LATEST, PROBE = 0.25, 0.3
#: Seconds after which a packet counts as lost, and the state of the link as unknown.
LOST = 1.5
#: Windows of the minimum round trip and of the rate of arrival, in seconds.
MEMORY, ARRIVALS = 10.0, 0.5
#: The share of the measured rate to use, and how the bitrate grows afterwards.
YIELD, GROWTH, GROWTH_INTERVAL, CALM = 0.8, 1.15, 0.25, 0.5
#: A queue shrinks after the bitrate went down. If it stays, and is not longer by the factor WORSE,
#: the cause is not our traffic, but for example a busy computer. The bitrate then waits PATIENCE
#: seconds before it goes down again, and twice as long each time, up to MOST_PATIENCE.
WORSE, PATIENCE, MOST_PATIENCE = 1.3, 5.0, 60.0
#: Seconds after a loss for which more losses are expected.
LOSS_MEMORY = 20.0
#: Minimum bits per pixel; below it, fewer pictures look better than worse ones.
LEAST_BITS = 0.03
LEAST_BITRATE = 50_000
#: Number of receivers that are waited for; a message names its receiver as it likes.
MOST_RECEIVERS = 64


@dataclasses.dataclass
class _Sent:
    sequence: int
    bits: int
    when: float


class Governor:
    """
    Estimate the link to one receiver.

    :param ceiling: maximum bits per second.
    """

    def __init__(self, ceiling: int) -> None:
        self.ceiling = ceiling
        self.bitrate = ceiling
        self.heard: Optional[float] = None
        #: Recent mean time of a packet from the sender to the receiver in seconds.
        self.latency = 0.0
        self._sent: deque[_Sent] = deque()
        self._trips: deque[tuple[float, float]] = deque()
        self._arrivals: deque[tuple[float, int]] = deque()
        self._waits: deque[tuple[float, float]] = deque()
        self._cut = -1e9
        self._waited = 0.0
        self._patience = 0.0
        self._calm_since = 0.0
        self._grown = 0.0
        self._rate = 0.0
        self._lost = 0
        self._loss: Optional[float] = None

    @property
    def round_trip(self) -> float:
        """The recent minimum round trip in seconds; 0: unknown."""
        return min((trip for _, trip in self._trips), default=0.0)

    def sent(self, sequence: int, size: int, now: float) -> None:
        """Record that a packet of ``size`` bytes was sent."""
        if self.heard is not None:
            self._sent.append(_Sent(sequence, size * 8, now))

    def loses(self, now: float) -> bool:
        """Return whether the link lost packets recently."""
        return self._loss is not None and now - self._loss < LOSS_MEMORY

    def acknowledged(self, sequence: int, lost: int, now: float) -> None:
        """
        Record that a packet has arrived; all packets before it have arrived too, or are lost.

        :param lost: number of incomplete packets since the receiver started to count.
        """
        if self.heard is None:
            self._calm_since = now
        elif lost > self._lost:
            self._loss = now
        self._lost = lost
        self.heard = now
        sent = None
        while self._sent and (sequence - self._sent[0].sequence) & 0xffffffff < 0x80000000:
            sent = self._sent.popleft()
        if sent is None or sent.sequence != sequence:
            return
        trip = now - sent.when
        self._trips.append((now, trip))
        # the way back has no queue, and takes half of the quickest round trip
        self.latency += 0.1 * (trip - self.round_trip / 2 - self.latency)
        while self._trips[0][0] < now - MEMORY:
            self._trips.popleft()
        self._arrivals.append((now, sent.bits))
        while self._arrivals[0][0] < now - ARRIVALS:
            self._arrivals.popleft()
        # A large packet takes its time on any link; that time is no queue.
        wire = sent.bits / max(self.bitrate, self._rate)
        waited = trip - self.round_trip - wire
        self._waits.append((now, waited))
        while self._waits[0][0] < now - QUEUE_SECONDS:
            self._waits.popleft()
        least = min(waited for _, waited in self._waits)
        if least > QUEUE:
            self._calm_since = now
            if (sent.when > self._cut and len(self._waits) >= QUEUE_ACKNOWLEDGEMENTS
                    and now - self._waits[0][0] > 0.7 * QUEUE_SECONDS
                    and (now - self._cut > self._patience or least > WORSE * self._waited)):
                self._patience = min(MOST_PATIENCE, max(PATIENCE, 2 * self._patience))
                self._waited = least
                self._yield(now)
        elif now - self._calm_since > CALM:
            self._patience = 0.0

    def may_send(self, now: float, pixels: int, interval: float) -> bool:
        """
        Return whether to send a picture now.

        :param pixels: pixels of the picture.
        :param interval: seconds since the last picture that was sent.
        """
        self._forget(now)
        if self._sent and now - self._sent[0].when > self.round_trip + LATEST:
            return interval > PROBE and now - (self.heard or now) > LOST
        # Pictures have jitter, so a slightly early one is on time.
        return interval * self.bitrate >= 0.8 * LEAST_BITS * pixels or interval > 1.0

    def grow(self, now: float, used: float) -> None:
        """
        Increase the bitrate after some time without a queue.

        :param used: recently sent bits per second. An unused bitrate was never tested on the
            link, so the bitrate grows only while the stream uses enough of it.
        """
        if (self.heard is None or now - self._calm_since < CALM
                or now - self._grown < GROWTH_INTERVAL):
            return
        self._grown = now
        if used > 0.3 * self.bitrate or self.bitrate < 4 * LEAST_BITRATE:
            self.bitrate = min(self.ceiling, int(self.bitrate * GROWTH))

    def _yield(self, now: float) -> None:
        """Lower the bitrate below the rate of arrival."""
        self._cut = now
        self._waits.clear()
        rate = self._arrival_rate(now)
        if rate:
            self._rate = rate
        lower = YIELD * min(self.bitrate, rate or self.bitrate)
        self._lower(int(lower))

    def _lower(self, bitrate: int) -> None:
        self.bitrate = max(min(LEAST_BITRATE, self.ceiling), bitrate)

    def _arrival_rate(self, now: float) -> float:
        if len(self._arrivals) < 2:
            return 0.0
        # The bits of the first packet arrived before the interval began.
        seconds = max(now, self._arrivals[-1][0]) - self._arrivals[0][0]
        bits = sum(bits for _, bits in self._arrivals) - self._arrivals[0][1]
        return bits / max(seconds, 0.02)

    def _forget(self, now: float) -> None:
        """Forget lost packets; halve the bitrate if all packets were lost."""
        if self._sent and now - self._sent[0].when > LOST:
            if self._sent[-1].when < now - LOST / 2 or (self.heard or 0) < now - LOST:
                self._lower(self.bitrate // 2)
            self._sent.clear()
            self._trips.clear()
