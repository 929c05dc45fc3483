# SPDX-License-Identifier: Apache-2.0
"""The control of point clouds by value: what it does on simulated links."""

from __future__ import annotations

from collections import deque
import math

import pytest

pytest.importorskip('zstandard', reason='the extra "point-clouds" is not installed')
from point_cloud_stream.codec import Coded
from point_cloud_stream.control import COARSEST, Control
from point_cloud_stream.parts import split

#: Points of a cloud, and bytes of their other fields.
POINTS, OTHER = 65_536, 42_000


def coded(resolution: float) -> Coded:
    """Return a cloud whose coordinates take a bit less for each doubling of the resolution."""
    bits = 5.3 if resolution == 0 else max(
        0.2, 5.3 - math.log2(resolution / 0.01))
    return Coded(bytes(OTHER + int(POINTS * bits / 8)), resolution, POINTS if resolution else 0)


class Link:
    """A link with a queue, and a publisher of 10 clouds a second."""

    def __init__(self, control: Control, rate: float, delay: float = 0.002) -> None:
        self.control, self.rate, self.delay = control, rate, delay
        self.now = 0.0
        self._free = 0.0
        self._part = 0
        self._arriving: deque[tuple[float, int]] = deque()
        #: (time of publishing, time of arrival, resolution)
        self.arrived: list[tuple[float, float, float]] = []

    def _until(self, now: float) -> None:
        while self._arriving and self._arriving[0][0] <= now:
            self.now, number = self._arriving.popleft()
            self.control.acknowledged(1, number, self.now)
        self.now = max(self.now, now)

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        tick = self.now
        while tick < end:
            # of the clouds that came meanwhile, the newest
            while tick + 0.1 <= self.now:
                tick += 0.1
                self.control.arrived(tick)
            self._until(tick)
            if self.control.arrived(tick):
                self._send(tick)
            tick += 0.1

    def _send(self, published: float) -> None:
        cloud = coded(self.control.resolution)
        parts = split(cloud.data, 1, 1, self._part + 1)
        self.control.sending(self._part + len(parts), cloud, self.now)
        for part in parts:
            begin = self.now
            while not self.control.may_send():
                if not self._arriving or self._arriving[0][0] > begin + 1.0:
                    self.now = begin + 1.0
                    self.control.give_up(self.now)
                    return
                self._until(self._arriving[0][0])
            self._part += 1
            self.control.sent(self._part, self.now)
            self._free = max(self._free, self.now) + 8 * len(part) / self.rate
            self._arriving.append((self._free + 2 * self.delay, self._part))
        self.arrived.append((published, self._free + self.delay, cloud.resolution))


def test_a_wide_link_keeps_the_resolution() -> None:
    link = Link(Control(0.01), 30e6)
    link.run(5.0)
    assert len(link.arrived) >= 50
    assert {resolution for _, _, resolution in link.arrived} == {0.01}


@pytest.mark.parametrize('delay', [0.001, 0.02, 0.05])
def test_a_thin_link_coarsens_within_a_second(delay: float) -> None:
    link = Link(Control(0.01), 30e6, delay)
    link.run(3.0)
    link.rate = 6.5e6
    link.run(4.0)
    assert sum(1 for published, _, _ in link.arrived if published >= 4.0) >= 27
    late = [arrived - published for published, arrived, _ in link.arrived if published >= 4.0]
    assert max(late) < 0.2 + 2 * delay
    assert 0.01 < link.control.resolution <= COARSEST


def test_resolution_returns_with_the_link() -> None:
    link = Link(Control(0.01), 6.5e6)
    link.run(4.0)
    assert link.control.resolution > 0.01
    link.rate = 30e6
    link.run(12.0)
    assert link.control.resolution == 0.01


@pytest.mark.parametrize('resolution', [0.01, 0.0])
def test_rate_falls_where_resolution_does_not_help(resolution: float) -> None:
    link = Link(Control(resolution), 1.5e6)
    link.run(10.0)
    rate = sum(1 for published, _, _ in link.arrived if published >= 3.0) / 7.0
    assert 1.5 < rate < 5.0
    # none waits behind another one
    assert max(arrived - published for published, arrived, _ in link.arrived[3:]) < 1.0
    assert link.control.resolution == (COARSEST if resolution else 0.0)


def test_max_rate_is_kept_with_jitter() -> None:
    control = Control(0.01, max_rate=5.0)
    due = [control.arrived(0.1 * number + 0.02 * (number % 3)) for number in range(100)]
    assert 49 <= sum(due) <= 52


def test_a_receiver_that_has_gone_delays_nobody() -> None:
    control = Control(0.01)
    control.acknowledged(1, 1, 0.0)
    control.acknowledged(2, 1, 0.0)
    for number in (2, 3):
        control.sent(number, 0.1)
        control.acknowledged(1, number, 0.2)
    assert not control.may_send()
    control.forget()
    assert control.may_send()
    # the other one acknowledges what was in flight
    control.sent(4, 0.3)
    control.acknowledged(1, 4, 0.4)
    assert control.may_send()


def test_nothing_is_known_without_acknowledgements() -> None:
    control = Control(0.01)
    control.sending(50, coded(0.01), 0.0)
    for number in range(50):
        assert control.may_send()
        control.sent(number, 0.0)
    control.forget()
    assert control.resolution == 0.01


def test_a_link_that_takes_nothing_coarsens_at_once() -> None:
    control = Control(0.01)
    control.acknowledged(1, 0, 0.0)
    control.sending(12, coded(0.01), 0.0)
    for number in (1, 2):
        control.sent(number, 0.0)
    assert not control.may_send()
    control.give_up(1.0)
    assert control.resolution > 0.02 and control.may_send()
