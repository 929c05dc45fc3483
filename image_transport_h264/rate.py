# SPDX-License-Identifier: Apache-2.0
"""
How much a link takes, judged by acknowledgements: first the bitrate gives way, then the frames.

The sender notes when each packet left; the receiver acknowledges each as it comes. What a packet
took beyond the quickest of late, and beyond its own time on the wire, it spent waiting in a queue.
A queue that lasts means that more is sent than the link takes: the bitrate goes below the rate at
which packets arrive, and no packet leaves until the queue has drained. Without acknowledgements
(a subscriber that isn't our decoder) nothing is known, and nothing is held back.
"""

from __future__ import annotations

from collections import deque
import dataclasses
from typing import Optional

#: Seconds of waiting that make a queue if nothing, over so many seconds and acknowledgements, took
#: less: what a loss or a busy processor holds up is followed by something quick.
QUEUE, QUEUE_SECONDS, QUEUE_ACKNOWLEDGEMENTS = 0.04, 0.3, 4
#: Seconds that packets may be under way, beyond the usual, before new pictures are left out.
LATEST = 0.25
#: Seconds after which a packet counts as lost, and the link as unknown.
LOST = 1.5
#: Seconds over which the quickest round trip and the rate of arrival are taken.
MEMORY, ARRIVALS = 10.0, 0.5
#: What is left of the measured rate, and how the bitrate grows afterwards.
YIELD, GROWTH, GROWTH_INTERVAL, CALM = 0.8, 1.15, 0.25, 0.5
#: A queue shrinks after the bitrate has given way. What stays, and isn't so many times as long, is
#: no queue of ours but a busy computer, say: the bitrate waits for so many seconds before it gives
#: way again, and for twice as many each time, up to a limit.
WORSE, PATIENCE, MOST_PATIENCE = 1.3, 5.0, 60.0
#: Seconds after a loss for which more are expected.
LOSS_MEMORY = 20.0
#: Bits per pixel below which fewer pictures look better than worse ones.
LEAST_BITS = 0.03
LEAST_BITRATE = 50_000


@dataclasses.dataclass
class _Sent:
    sequence: int
    bits: int
    when: float


class Governor:
    """
    Follows one receiver.

    :param ceiling: bits per second that are never exceeded.
    """

    def __init__(self, ceiling: int) -> None:
        self.ceiling = ceiling
        self.bitrate = ceiling
        self.heard: Optional[float] = None
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
        """The quickest round trip of late, in seconds; 0 while unknown."""
        return min((trip for _, trip in self._trips), default=0.0)

    def sent(self, sequence: int, size: int, now: float) -> None:
        """Note that a packet of ``size`` bytes has left."""
        if self.heard is not None:
            self._sent.append(_Sent(sequence, size * 8, now))

    def loses(self, now: float) -> bool:
        """Return whether packets were lost of late."""
        return self._loss is not None and now - self._loss < LOSS_MEMORY

    def acknowledged(self, sequence: int, lost: int, now: float) -> None:
        """
        Note that the receiver has a packet; those before it are there too, or lost.

        :param lost: packets that didn't come whole, since the receiver began to count.
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
        while self._trips[0][0] < now - MEMORY:
            self._trips.popleft()
        self._arrivals.append((now, sent.bits))
        while self._arrivals[0][0] < now - ARRIVALS:
            self._arrivals.popleft()
        # a large packet takes its time on any link: that is no queue
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
        Whether a picture is to be sent now.

        :param interval: seconds since the last one that was sent.
        """
        self._forget(now)
        if self._sent and now - self._sent[0].when > self.round_trip + LATEST:
            return False
        # a little early is in time: pictures come with jitter
        return interval * self.bitrate >= 0.8 * LEAST_BITS * pixels or interval > 1.0

    def grow(self, now: float, used: float) -> None:
        """
        Let the bitrate grow after a while without a queue.

        :param used: bits per second sent of late; what isn't used tells nothing of the link, so
            the bitrate goes no further than a few times beyond.
        """
        if (self.heard is None or now - self._calm_since < CALM
                or now - self._grown < GROWTH_INTERVAL):
            return
        self._grown = now
        if used > 0.3 * self.bitrate or self.bitrate < 4 * LEAST_BITRATE:
            self.bitrate = min(self.ceiling, int(self.bitrate * GROWTH))

    def _yield(self, now: float) -> None:
        """Go below the rate at which packets arrived."""
        self._cut = now
        self._waits.clear()
        rate = self._arrival_rate(now)
        if rate:
            self._rate = rate
        lower = YIELD * min(self.bitrate, rate or self.bitrate)
        self.bitrate = max(LEAST_BITRATE, int(lower))

    def _arrival_rate(self, now: float) -> float:
        if len(self._arrivals) < 2:
            return 0.0
        # the first one's bits had passed before the interval began
        seconds = max(now, self._arrivals[-1][0]) - self._arrivals[0][0]
        bits = sum(bits for _, bits in self._arrivals) - self._arrivals[0][1]
        return bits / max(seconds, 0.02)

    def _forget(self, now: float) -> None:
        """Give up on packets that are lost, with half the bitrate if all were."""
        if self._sent and now - self._sent[0].when > LOST:
            if self._sent[-1].when < now - LOST / 2 or (self.heard or 0) < now - LOST:
                self.bitrate = max(LEAST_BITRATE, self.bitrate // 2)
            self._sent.clear()
            self._trips.clear()
