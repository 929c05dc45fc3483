# SPDX-License-Identifier: Apache-2.0
"""The division of a link's bandwidth by value, and streams that share a simulated link."""

from __future__ import annotations

import dataclasses
import math
import time
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest

from image_transport_h264.budget import AHEAD, Budget
from image_transport_h264.sharing import (
    Claim,
    claim_of,
    divide,
    Link,
    links_of,
    LISTEN,
    MOST_STREAMS,
    needed,
    PAYLOAD,
    VALID,
)


def claims(*values: tuple[float, ...]) -> dict[str, Claim]:
    """Return claims a, b, ... of (priority, floor, need, ceiling)."""
    return {name: Claim(*each, 0.0) for name, each in zip('abcdef', values)}


@pytest.mark.parametrize(('bandwidth', 'values', 'shares'), [
    # all ceilings fit
    (20, [(1, 1, 2, 8), (1, 1, 2, 8)], [8, 8]),
    # needs fit; the rest goes to those with the least
    (10, [(1, 1, 2, 9), (1, 1, 6, 9)], [4, 6]),
    # needs do not fit: the small one is served, the others are equal
    (10, [(1, 1, 2, 9), (1, 1, 9, 9), (1, 1, 9, 9)], [2, 4, 4]),
    # priority is a weight
    (9, [(2, 1, 9, 9), (1, 1, 9, 9)], [6, 3]),
    # a floor comes before the weight of others
    (9, [(100, 1, 9, 9), (1, 3, 9, 9)], [6, 3]),
    # less than the floors: everybody gets something
    (3, [(1, 4, 9, 9), (1, 4, 9, 9), (2, 9, 9, 9)], [0.75, 0.75, 1.5]),
    (1, [(1, 0.1, 9, 9), (1, 4, 9, 9)], [0.1, 0.9]),
    # a need below the floor, and a ceiling below the need, count as these
    (10, [(1, 3, 0, 0), (1, 1, 9, 2)], [3, 7]),
    (10, [(1, 0, 0, 0)], [0]),
    (10, [], []),
])
def test_bandwidth_is_divided_by_need_and_priority(
    bandwidth: float, values: list[Any], shares: list[float],
) -> None:
    found = divide(bandwidth, claims(*values))
    assert list(found.values()) == pytest.approx(shares, rel=1e-6)
    assert sum(found.values()) <= bandwidth


def test_need_follows_use_and_ignores_small_changes() -> None:
    assert needed(1e6, math.inf, 0.0, 8e6, short=False) == 2e6
    assert needed(1.2e6, math.inf, 2e6, 8e6, short=False) == 2e6
    assert needed(0.5e6, math.inf, 2e6, 8e6, short=False) == 1e6
    assert needed(7e6, math.inf, 2e6, 8e6, short=False) == 8e6
    # the share limits the stream, or the stream says so
    assert needed(1e6, 1.5e6, 2e6, 8e6, short=False) == 8e6
    assert needed(1e6, math.inf, 2e6, 8e6, short=True) == 8e6
    assert needed(0.0, 1e6, 2e6, 8e6, short=False) == 0.0


def message(labels: list[str], data: list[float]) -> Any:
    dim = [SimpleNamespace(label=label) for label in labels]
    return SimpleNamespace(layout=SimpleNamespace(dim=dim), data=data)


def report(name: str, claim: Claim) -> Any:
    return message([name], list(dataclasses.astuple(claim)))


def wants(need: float, share: float = 0.0) -> Claim:
    return Claim(1.0, 1e5, need, 8e6, share)


def test_new_stream_listens_before_it_takes_a_share() -> None:
    link = Link(10e6, 0.0)
    assert link.share('new', wants(8e6), LISTEN / 2) == 1e5
    link.heard(report('old', wants(8e6, 7e6)), LISTEN / 2)
    # at first what the other has left, then what is fair
    assert link.share('new', wants(8e6), LISTEN) == pytest.approx(1e6)
    link.heard(report('old', wants(8e6, 4e6)), LISTEN)
    assert link.share('new', wants(8e6), LISTEN) == pytest.approx(4e6)


def test_stream_that_is_silent_leaves_its_share() -> None:
    link = Link(10e6, -LISTEN)
    link.heard(report('old', wants(8e6, 4e6)), 0.0)
    assert link.share('new', wants(8e6), VALID / 2) == pytest.approx(4e6)
    assert link.share('new', wants(8e6), VALID) == pytest.approx(8e6)


def test_shares_of_all_streams_stay_within_the_bandwidth() -> None:
    """Streams come one after another; after each report the sum is what the link has for them."""
    links: dict[str, Link] = {}
    shares: dict[str, float] = {}
    for step in range(80):
        now = step / 4
        if step % 16 == 0 and len(links) < 4:
            links[f'stream {len(links)}'] = Link(10e6, now)
        for name, link in links.items():
            shares[name] = link.share(name, wants(8e6), now)
            for other, each in links.items():
                if other != name:
                    each.heard(report(name, wants(8e6, shares[name])), now)
        # a new stream has its floor before the others have heard of it
        assert sum(shares.values()) <= PAYLOAD * 10e6 + 1e5 + 1
    assert list(shares.values()) == pytest.approx([2e6] * 4)


def test_bandwidth_holds_for_a_hundred_streams() -> None:
    names = [f'stream {number}' for number in range(100)]
    links = {name: Link(100e6, 0.0) for name in names}
    shares: dict[str, float] = {}
    for now in (0.0, 1.0, 2.0, 3.0):
        for name in names:
            shares[name] = links[name].share(name, wants(8e6), now)
            reported = report(name, wants(8e6, shares[name]))
            for other in names:
                if other != name:
                    links[other].heard(reported, now)
    assert sum(shares.values()) <= PAYLOAD * 100e6 + 1
    assert min(shares.values()) > 0.7e6


def test_hostile_reports_are_bounded() -> None:
    link = Link(10e6, -LISTEN)
    hostile = dataclasses.replace(wants(8e6, 8e6), floor=0.0)
    for number in range(2 * MOST_STREAMS):
        link.heard(report(f'stream {number}', hostile), 0.0)
    # the floor is left
    assert link.share('own', wants(8e6), 0.0) == 1e5
    # those that are silent make room
    link.heard(report('old', wants(8e6, 7e6)), VALID)
    assert link.share('own', wants(8e6), VALID) == pytest.approx(1e6)


@pytest.mark.parametrize(('labels', 'data'), [
    ([], [1, 1, 1, 1, 1, 1]), (['/a', '/b'], [1, 1, 1, 1, 1, 1]), (['/a'], [1, 1, 1, 1, 1]),
    (['/a'], [0, 1, 1, 1, 1, 1]), (['/a'], [1e3, 1, 1, 1, 1, 1]), (['/a'], [1, -1, 1, 1, 1, 1]),
    (['/a'], [1, 1, math.nan, 1, 1, 1]), (['/a'], [1, 1, 1, math.inf, 1, 1]),
    (['/a'], [1, 1, 1, 1, 1, 1e300]), (['/' + 255 * 'a'], [1, 1, 1, 1, 1, 1])])
def test_invalid_report_is_no_claim(labels: list[str], data: list[float]) -> None:
    assert claim_of(message(labels, data)) is None


def test_report_and_announcement_are_read() -> None:
    assert claim_of(message(['/a'], [1, 2, 3, 4, 5, 6])) == ('/a', Claim(1, 2, 3, 4, 5, 6))
    names = [f'/fogros2/{name}/link_in' for name in 'abcd']
    assert links_of(message([names[0], 'no topic', *names[1:]], [
        1e6, 1e6, 0.0, math.nan, 2e6])) == {names[0]: 1e6, names[3]: 2e6}


def test_share_below_the_minimum_is_reported_once() -> None:
    node = mock.Mock()
    node.declare_parameter.return_value.value = 1.0
    budget = Budget(node, '/camera/h264', lambda: 1)
    (_, announced, join, *_), = (call.args for call in node.create_subscription.call_args_list)
    report_now = node.create_timer.call_args.args[1]
    warning = node.get_logger.return_value.warning
    budget.sent(1000, floor=1e5, latency=0.0)
    join(message(['/fogros2/m/link_in'], [1e6]))
    report_now()
    assert (announced, warning.call_count) == ('/camera/h264/link', 0)
    budget.sent(1000, floor=1e6, latency=0.0)
    report_now()
    report_now()
    assert [call.args[0] for call in warning.call_args_list] == [
        '/camera/h264 gets 800 kbit/s of the bandwidth of its machine, and needs at least 1000 '
        'kbit/s: give the machine more bandwidth=, or fewer streams']


def test_stream_waits_for_all_that_it_has_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    node, slept = mock.Mock(), []
    node.declare_parameter.return_value.value = 1.0
    monkeypatch.setattr(time, 'monotonic', lambda: 100.0)
    monkeypatch.setattr(time, 'sleep', slept.append)
    budget = Budget(node, '/camera/h264', lambda: 1)
    budget.share = 1e6
    for _ in range(3):
        budget.sent(25_000, floor=1e5, latency=0.0)
        budget.pace()
    # two tenths of a second each, less what a stream may be ahead
    assert slept == pytest.approx([0.2 - AHEAD, 0.4 - AHEAD, 0.6 - AHEAD])
