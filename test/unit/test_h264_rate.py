# SPDX-License-Identifier: Apache-2.0
"""Adaptation against a simulated link, on a simulated clock: nothing here waits."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import heapq
import random

import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
from image_transport_h264.codec import Settings
from image_transport_h264.control import Control
from image_transport_h264.rate import Governor, LEAST_BITS

PIXELS = 160 * 120
#: Bits of a picture: most, as a VGA scene has, and least.
MOST, LEAST = 60_000, 2000
#: Seconds that the link's queue holds.
QUEUE = 1.0
Rate = Callable[[float], float]


@dataclasses.dataclass
class Record:
    """A packet's fate: seconds on the simulated clock."""

    sent: float
    arrived: float
    size: int
    bitrate: int


def stream(
    rate: Rate, seconds: float, *, control: Control | None = None, delay: float = 0.005,
    stall: Callable[[float], float] = lambda now: 0.0, loss: float = 0.0,
    cut: Callable[[float], bool] = lambda now: False,
) -> list[Record]:
    """
    Send pictures over a link and return what became of them.

    :param rate: the link's bits per second at a time; what its queue can't hold is lost.
    :param stall: seconds that an acknowledgement sent at a time is late, as on a busy computer.
    :param loss: part of the packets that never come.
    :param cut: whether nothing comes through at a time.
    """
    control = control or Control(Settings(bitrate=8_000_000))
    settings, chance = control.asked, random.Random(1)
    free, lost, records = 0.0, 0, []
    acknowledgements: list[tuple[float, int, int]] = []
    for number in range(int(seconds * 30)):
        now = 100 + number / 30
        while acknowledgements and acknowledgements[0][0] <= now:
            when, sequence, count = heapq.heappop(acknowledgements)
            control.heard(1, sequence, count, when)
        if not control.due(now, PIXELS):
            continue
        settings = control.settings(settings, now)
        # as an encoder does: about its quality's size, within the bitrate
        coded = chance.uniform(0.8, 1.2) * min(MOST, settings.bitrate / settings.rate)
        size = int(max(LEAST, coded) / 8)
        control.sent(number, size, now)
        if free - now > QUEUE or cut(now) or chance.random() < loss:
            lost += 1
            records.append(Record(now - 100, now - 100, 0, settings.bitrate))
            continue
        free = max(free, now) + size * 8 / rate(now)
        records.append(Record(now - 100, free + delay - 100, size, settings.bitrate))
        heapq.heappush(acknowledgements, (free + 2 * delay + stall(now), number, lost))
    return records


def between(records: list[Record], begin: float, end: float) -> list[Record]:
    return [record for record in records if begin <= record.sent < end]


def late(records: list[Record]) -> float:
    """Return the worst time that a packet took."""
    return max(record.arrived - record.sent for record in records)


def bits(records: list[Record], seconds: float) -> float:
    return sum(record.size for record in records) * 8 / seconds


def test_link_with_room_keeps_its_bitrate() -> None:
    records = stream(lambda now: 50e6, 4)
    assert len(records) == 120
    assert {record.bitrate for record in records} == {8_000_000}


def test_busy_computer_does_not_starve_the_stream() -> None:
    """All acknowledgements late, for seconds: giving way again and again would help nobody."""
    chance = random.Random(2)

    def stall(now: float) -> float:
        return 0.08 + chance.uniform(0.0, 0.02) if 101 < now < 107 else 0.0

    control = Control(Settings(bitrate=8_000_000))
    records = stream(lambda now: 50e6, 10, control=control, stall=stall)
    used = bits(between(records, 0, 1), 1)
    assert min(record.bitrate for record in records) > 0.4 * used


def test_bitrate_follows_a_link_that_slows_and_recovers() -> None:
    """Within a second the stream fits; latency stays bounded; it recovers afterwards."""
    records = stream(lambda now: 1e6 if 104 <= now < 110 else 10e6, 20)
    before = between(records, 2, 4)
    assert bits(before, 2) > 1.3e6
    squeezed = between(records, 5, 10)
    assert bits(squeezed, 5) < 1.0e6
    assert late(between(records, 4, 5)) < 1.0
    assert late(between(records, 5.5, 10)) < 0.35
    # still most of the pictures: the bitrate gave way first
    assert len(squeezed) > 0.8 * 150
    after = between(records, 17, 20)
    assert len(after) == 90
    assert bits(after, 3) > 0.9 * bits(before, 2)


def test_very_slow_link_drops_pictures_not_latency() -> None:
    """Below what a picture needs at the least, fewer are sent, and none waits in a queue."""
    control = Control(Settings(bitrate=8_000_000))
    records = stream(lambda now: 40e3, 20, control=control)
    end = between(records, 12, 20)
    assert 8 < len(end) < 200
    assert late(end) < 1.5


def test_late_acknowledgements_lower_nothing() -> None:
    """Acknowledgements that are late now and then lower nothing."""
    records = stream(lambda now: 50e6, 8,
                     stall=lambda now: 0.2 if int(now * 30) % 20 == 0 else 0.0)
    assert {record.bitrate for record in records} == {8_000_000}
    assert len(records) >= 235


def test_losses_bring_protection_at_the_same_bitrate() -> None:
    control = Control(Settings(bitrate=8_000_000))
    records = stream(lambda now: 50e6, 6, control=control, loss=0.05)
    assert {record.bitrate for record in records} == {8_000_000}
    assert len(records) >= 175
    assert control.protects(106.0)
    assert not control.protects(140.0)


def test_stream_resumes_after_a_cut() -> None:
    records = stream(lambda now: 10e6, 16, cut=lambda now: 102 <= now < 106)
    assert len(between(records, 2.5, 6)) < 25
    assert len(between(records, 14, 16)) > 50


@pytest.mark.parametrize('end', [106.0, 106.5, 107.2])
def test_picture_follows_the_end_of_a_cut_at_once(end: float) -> None:
    """Whenever a cut ends, the next picture is the one that finds out."""
    records = stream(lambda now: 10e6, 8, cut=lambda now: 102 <= now < end)
    first = next(record for record in records if record.size and record.sent >= end - 100)
    assert first.sent - (end - 100) < 0.35
    # and the next ones follow at the stream's rate
    assert len(between(records, first.sent, first.sent + 0.5)) > 8


def test_stream_without_acknowledgements_is_not_limited() -> None:
    control = Control(Settings())
    assert all(control.due(n / 30, PIXELS) for n in range(300))
    assert control.settings(Settings(), 10.0) == Settings()


def test_max_rate_limits_pictures_per_second() -> None:
    control = Control(Settings(), max_rate=10.0)
    jitter = random.Random(3)
    sent = sum(control.due(n / 30 + jitter.uniform(0, 0.01), PIXELS) for n in range(300))
    assert 97 <= sent <= 103


def test_the_slowest_receiver_decides_until_it_is_gone() -> None:
    control, settings = Control(Settings(bitrate=8_000_000)), Settings()
    now, queue, lowest = 0.0, 0.0, 8_000_000
    for number in range(300):
        now = number / 30
        if control.due(now, PIXELS):
            settings = control.settings(settings, now)
            control.sent(number, 4000, now)
        control.heard(1, number, 0, now + 0.005)
        if number < 90:
            queue += 0.02
            control.heard(2, max(0, number - int(queue * 30)), 0, now + 0.006)
        if number == 90:
            lowest = settings.bitrate
    assert lowest < 8_000_000
    assert control.settings(settings, now).bitrate >= lowest


def test_low_bitrate_of_the_user_is_kept_on_every_link() -> None:
    control = Control(Settings(bitrate=20_000))
    for rate in (50e6, 8e3):
        records = stream(lambda now, rate=rate: rate, 6, control=control)
        assert max(record.bitrate for record in records) == 20_000


def test_bitrate_of_the_user_is_the_ceiling() -> None:
    control = Control(Settings(bitrate=8_000_000))
    control.heard(1, 0, 0, 0.0)
    control.ask(Settings(bitrate=500_000), 0.0, True)
    assert control.settings(Settings(), 1.0).bitrate == 500_000
    with pytest.raises(ValueError, match='max_rate'):
        control.ask(Settings(), -1.0, True)


def test_share_of_a_link_limits_bitrate_and_pictures() -> None:
    control = Control(Settings(bitrate=8_000_000))
    control.share = 1e6
    assert control.settings(Settings(bitrate=8_000_000), 100.0).bitrate == 1_000_000
    # a share below what a picture needs at the least: fewer pictures
    control.share = 0.5 * LEAST_BITS * PIXELS * 30
    sent = 0
    for number in range(300):
        if control.due(100 + number / 30, PIXELS):
            control.sent(number, 100, 100 + number / 30)
            sent += 1
    assert 150 <= sent <= 200


def test_time_on_the_wire_is_no_queue() -> None:
    """A large picture takes its time on a slow link, also where none waits."""
    governor, now = Governor(1_000_000), 0.0
    for number in range(200):
        # a still scene, then motion
        bits = 400 if number < 20 else 45_000
        governor.sent(number, bits // 8, now)
        governor.acknowledged(number, 0, now + 0.005 + bits / 1e6)
        now += 0.05
    assert governor.bitrate == 1_000_000
