# SPDX-License-Identifier: Apache-2.0
"""Tests of the stream that carries a VPN: its lines, its window, its queue, and the path."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import heapq
import itertools
import random
import threading
from typing import Any

import pytest

from fogros2.errors import ConfigurationError, ShellError
from fogros2.model import MachineSpec
from fogros2_features.vpn_path import carrier, feature, VpnPath
from fogros2_features.vpn_path.carrier import Queue, Window


def test_each_datagram_is_one_line():
    pairs = [bytes(pair) for pair in itertools.product(b'\\en\nd', repeat=4)]
    for data in [b'', bytes(range(256)), random.Random(1).randbytes(1500), *pairs]:
        text = carrier.line(data)
        assert text.index(b'\n') == len(text) - 1
        assert carrier.datagram(text[1:-1]) == data


def test_full_queue_drops_its_oldest():
    queue = Queue()
    count = carrier.LEAST_QUEUE // 1000 + 5
    for number in range(count):
        queue.add(b'%04d' % number * 250, 0.0)
    assert queue.take() == b'0005' * 250
    # a faster link takes no longer for more
    for number in range(count, 2 * count):
        queue.add(b'%04d' % number * 250, 3 * carrier.LEAST_QUEUE / carrier.QUEUE)
    assert queue.take() == b'0006' * 250


class Link:
    """
    A link in simulated time, with a sender that always has something to send.

    :ivar rate: bytes per second. :ivar delay: seconds one way.
    """

    def __init__(self, rate: float, delay: float) -> None:
        self.rate, self.delay = rate, delay
        self.now = self.free = 0.0
        self.window = Window()
        self.delivered = 0
        self._sent = 0
        self._events: list[tuple[float, int]] = []

    def run(self, seconds: float, seen: Callable[[float, float], None] = lambda rate, wait: None,
            size: int = 1400) -> float:
        """Send for some seconds; return the share of the rate that arrived."""
        until, before = self.now + seconds, self.delivered
        while self.now < until:
            while self.window.admits():
                self._sent += size
                self.free = max(self.free, self.now) + size / self.rate
                self.window.sent(size, self.now, more=True)
                heapq.heappush(self._events, (self.free + 2 * self.delay, self._sent))
                seen(self.window.rate, self.free - self.now)
            self.now, self.delivered = heapq.heappop(self._events)
            self.window.arrived(self.delivered, self.now)
        return (self.delivered - before) / seconds / self.rate


@pytest.mark.parametrize('delay', [0.0005, 0.02, 0.15])
def test_window_fills_a_link_and_no_buffer(delay):
    link = Link(1.25e6, delay)
    # it doubles each round trip, and knows the rate after some
    link.run(10.0)
    waits = []
    assert link.run(30.0, lambda rate, wait: waits.append(wait)) > 0.95
    assert max(waits) < 2 * carrier.DELAY
    assert link.window.rate == pytest.approx(link.rate, rel=0.1)


def test_window_follows_rate_and_round_trip():
    link = Link(1.25e6, 0.02)
    link.run(5.0)
    link.rate = 0.125e6
    link.run(5.0)
    waits = []
    assert link.run(5.0, lambda rate, wait: waits.append(wait)) > 0.9
    assert max(waits) < 2 * carrier.DELAY
    link.rate, link.delay = 1.25e6, 0.06
    # the round trip is measured anew each 10 s
    link.run(25.0)
    assert link.run(5.0) > 0.9


def test_low_traffic_does_not_lower_the_rate():
    link = Link(1.25e6, 0.01)
    link.run(3.0)
    for _ in range(100):
        link.now += 0.5
        link.window.sent(200, link.now, more=False)
        link.window.arrived(link.delivered + link.window.under_way, link.now + 0.02)
    assert link.window.rate > 1e6


def test_other_end_frees_no_more_than_was_sent():
    window = Window()
    for number in range(10):
        window.sent(1000, float(number), more=True)
    for total, under_way in ((-1, 10_000), (999, 10_000), (2500, 8000), (10 ** 30, 0), (0, 0)):
        window.arrived(total, 20.0)
        assert window.under_way == under_way


@pytest.mark.parametrize(('own', 'path', 'answered', 'silence', 'working', 'expected'), [
    ('auto', 'udp', False, 2.9, 0.0, 'udp'),
    ('auto', 'udp', False, 3.1, 0.0, 'stream'),
    ('auto', 'udp', True, 9.9, 0.0, 'udp'),
    ('auto', 'udp', True, 10.1, 0.0, 'stream'),
    ('auto', 'stream', True, 0.1, 9.9, 'stream'),
    ('auto', 'stream', True, 0.1, 10.0, 'udp'),
    ('auto', 'stream', False, 20.0, 0.0, 'stream'),
    ('udp', 'udp', False, 20.0, 0.0, 'udp'),
    ('stream', 'udp', False, 0.0, 0.0, 'stream'),
    ('stream', 'stream', True, 0.0, 20.0, 'stream'),
])
def test_path(own, path, answered, silence, working, expected):
    assert feature.choose(
        own, path, answered=answered, silence=silence, working=working) == expected


def test_other_values_are_refused():
    assert VpnPath.options() == 'auto'
    with pytest.raises(ConfigurationError, match="vpn_path='tcp' is no path of a VPN"):
        VpnPath.options('tcp')


class Shells:
    """A machine whose shell opens a stream when a test lets it."""

    def __init__(self) -> None:
        self.opening, self.opened, self.ended = (threading.Event() for _ in range(3))
        self.dialled: list[str] = []
        self.spec = MachineSpec('planner', 'ssh')
        self.port = self.robot_port = 9
        self.silence = self.direct = None

    def connect(self, *_: Any, **__: Any) -> Shells:
        return self

    open_outside = connect

    def open(self, command: Any) -> Shells:
        self.opening.set()
        self.opened.wait(60.0)
        return self

    def write(self, data: bytes) -> None:
        pass

    def readline(self) -> bytes:
        self.ended.wait(60.0)
        return b''

    def close(self) -> None:
        self.ended.set()

    def dial(self, relay: str, carried: str) -> None:
        self.dialled.append(carried)

    def advise(self, remedy: str) -> None:
        self.remedy = remedy

    def step(self, name: str) -> contextlib.AbstractContextManager[list[str]]:
        return contextlib.nullcontext([])


@pytest.fixture
def machine(monkeypatch):
    shells = Shells()
    monkeypatch.setattr(feature, 'shells', shells)
    return shells


def test_path_stays_after_the_end_of_the_way(machine, monkeypatch):
    """The machine's record may be deleted by then."""
    monkeypatch.setattr(feature, 'FIRST', 0.0)
    monkeypatch.setattr(feature.carrier, 'READY', b'')
    way = feature.Way(machine, 'auto')
    assert machine.opening.wait(60.0)
    way.close()
    looking = [thread for thread in threading.enumerate() if thread.name == 'fog-path']
    machine.opened.set()
    for thread in looking:
        thread.join(60.0)
    assert machine.dialled == []


def test_machine_that_does_not_answer_holds_no_launch(machine, monkeypatch):
    monkeypatch.setattr(feature, 'OPENING', 0.05)
    machine.opened.set()
    with pytest.raises(ShellError, match='does not run the program'):
        feature.Way(machine, 'stream')
