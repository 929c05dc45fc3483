# SPDX-License-Identifier: Apache-2.0
"""How many complete images are under way, on a simulated link and clock: nothing here waits."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import heapq
import random

import pytest

from image_transport_h264.lazy import STREAM_QOS
from image_transport_h264.pacing import MANY, MEMORY, MOST, Pace, Sent
from image_transport_h264.slices import QUEUED

CAMERA = 30.0
#: Seconds that an image of 40 kB is on a wire of 10 Mbit/s.
WIRE = 0.034


@dataclasses.dataclass
class Outcome:
    """
    What became of the images of a camera.

    :param rates: images that arrived a second, in each second.
    :param waits: seconds that each image waited in the link's queue.
    :param windows: the window at each acknowledgement.
    """

    rates: list[float]
    waits: list[float]
    windows: list[int]


def drive(
    seconds: float, *, wire: Callable[[float], float] = lambda now: WIRE, trip: float = 0.002,
    rate: float = CAMERA, late: Callable[[random.Random], float] = lambda chance: 0.0,
    many: float = MANY,
) -> Outcome:
    """
    Send a camera's images over a link; the newest one leaves when there is room for it.

    :param wire: seconds that an image takes on the wire, at a time.
    :param trip: seconds of the round trip of an empty message.
    :param late: seconds that an acknowledgement is late by chance.
    :param many: as of ``Pace``.
    """
    pace, chance = Pace(many), random.Random(1)
    outcome = Outcome([0.0] * int(seconds), [], [])
    acknowledgements: list[tuple[float, int, Sent]] = []
    free = 0.0
    taken = -1
    now = 0.0
    while now < seconds:
        newest = int(now * rate)
        if pace.may_send() and newest > taken:
            taken = newest
            begin = max(now, free)
            outcome.waits.append(begin - now)
            free = begin + wire(now)
            heapq.heappush(acknowledgements, (
                free + trip + late(chance), newest, pace.sent(now)))
            continue
        image = (newest + 1) / rate + 1e-9 if pace.may_send() else seconds
        now = min(image, acknowledgements[0][0] if acknowledgements else seconds)
        while acknowledgements and acknowledgements[0][0] <= now:
            when, _, sent = heapq.heappop(acknowledgements)
            pace.acknowledged(sent, when)
            outcome.windows.append(pace.window)
            if when < seconds:
                outcome.rates[int(when)] += 1
    return outcome


def mean(values: list[float]) -> float:
    """Return the arithmetic mean."""
    return sum(values) / len(values)


@pytest.mark.parametrize('wire', [0.034, 0.049, 0.1])
def test_short_link_is_filled_by_one_image(wire: float) -> None:
    outcome = drive(100, wire=lambda now: wire)
    assert mean(outcome.rates) >= 0.9 * min(CAMERA, 1 / wire)
    # a larger window is tried now and then, and never two
    assert max(outcome.windows) == 2
    assert outcome.windows.count(2) < 0.05 * len(outcome.windows)
    assert max(outcome.waits) <= wire + 1e-6


def test_slices_leave_a_short_link_no_pause() -> None:
    outcome = drive(100, wire=lambda now: 0.012, rate=1000.0, trip=0.004, many=QUEUED)
    assert mean(outcome.rates) >= 0.98 / 0.012
    assert outcome.windows.count(2) > 0.9 * len(outcome.windows)
    assert mean(outcome.waits) <= 0.012


@pytest.mark.parametrize('trip', [0.03, 0.1, 0.2])
def test_long_link_is_filled_by_several_images(trip: float) -> None:
    outcome = drive(100, trip=trip)
    assert mean(outcome.rates[5:]) >= 0.8 / WIRE
    assert max(outcome.waits) < 2 * WIRE


def test_long_fast_link_carries_every_image() -> None:
    outcome = drive(60, wire=lambda now: 0.001, trip=0.15)
    assert mean(outcome.rates[5:]) >= 0.95 * CAMERA


def test_link_that_slows_down_gets_no_queue() -> None:
    outcome = drive(60, wire=lambda now: WIRE if now < 20 else 10 * WIRE, trip=0.05)
    assert mean(outcome.rates[30:]) >= 0.8 / (10 * WIRE)
    last = outcome.waits[-int(20 / (10 * WIRE)):]
    assert mean(last) < 5 * WIRE


def test_late_acknowledgements_do_not_shrink_window() -> None:
    # every second image repeats a part, as with 2 % of packets lost
    outcome = drive(100, trip=0.1, late=lambda chance: 0.03 * (chance.random() < 0.5))
    assert mean(outcome.rates[5:]) >= 0.7 / WIRE


def test_image_given_up_leaves_one_under_way() -> None:
    pace = Pace()
    for at in range(40):
        pace.acknowledged(pace.sent(at / 30), at / 30 + 0.001)
    assert pace.window > 1
    sent = [pace.sent(2.0) for _ in range(pace.window)]
    assert not pace.may_send()
    for _ in sent:
        pace.expired(4.0)
    assert pace.window == 1
    pace.sent(4.0)
    assert not pace.may_send()


def test_slow_source_is_never_held_up() -> None:
    outcome = drive(3 * MEMORY, rate=5.0)
    assert mean(outcome.rates) == pytest.approx(5.0, rel=0.05)
    assert max(outcome.waits) == 0.0


def test_publisher_keeps_all_images_under_way() -> None:
    assert STREAM_QOS.depth >= MOST
