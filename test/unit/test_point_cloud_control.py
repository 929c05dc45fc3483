# SPDX-License-Identifier: Apache-2.0
"""The control of point clouds by value: what it does on simulated links."""

from __future__ import annotations

import math

import pytest

from image_transport_h264.slices import LEAST

pytest.importorskip('zstandard', reason='the extra "point-clouds" is not installed')
from point_cloud_stream.codec import Coded
from point_cloud_stream.control import COARSEST, Control

#: Points of a cloud, and bytes of their other fields.
POINTS, OTHER = 65_536, 42_000


def coded(resolution: float) -> Coded:
    """Return a cloud whose coordinates take a bit less for each doubling of the resolution."""
    bits = 5.3 if resolution == 0 else max(
        0.2, 5.3 - math.log2(resolution / 0.01))
    return Coded(bytes(OTHER + int(POINTS * bits / 8)), resolution, POINTS if resolution else 0)


class Link:
    """A link, and a publisher of 10 clouds a second, each of which waits for the one before."""

    def __init__(self, control: Control, rate: float, delay: float = 0.002) -> None:
        self.control, self.rate, self.delay = control, rate, delay
        self.now = self._free = 0.0
        self._quickest = math.inf
        #: (time of publishing, time of arrival, resolution)
        self.arrived: list[tuple[float, float, float]] = []

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            # of the clouds that came meanwhile, the newest
            while self.now + 0.1 <= self._free:
                self.now += 0.1
                self.control.arrived(self.now)
            if self.control.arrived(self.now):
                cloud = coded(self.control.resolution)
                begin = max(self.now, self._free)
                self._free = begin + 8 * len(cloud.data) / self.rate
                self._quickest = min(
                    self._quickest, 2 * self.delay + 8 * LEAST / self.rate)
                back = self._free + 2 * self.delay
                self.control.crossed(cloud, back - begin, self._quickest, back)
                self.arrived.append((self.now, self._free + self.delay, cloud.resolution))
            self.now += 0.1


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


def test_a_link_that_takes_nothing_coarsens_at_once() -> None:
    control = Control(0.01)
    control.crossed(coded(0.01), 2.0, 0.0, 2.0)
    assert control.resolution > 0.02
