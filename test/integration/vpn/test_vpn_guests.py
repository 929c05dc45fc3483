# SPDX-License-Identifier: Apache-2.0
"""Nodes of a second robot and of a machine hear each other; both robots are behind NATs."""

from __future__ import annotations

import pytest

from rigs.vpn_guest import Guest, guest
from rigs.vpn_lab import Lab

__all__ = ['guest']


@pytest.fixture(params=['cyclonedds', 'fastdds'])
def middleware(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_two_robots_hear_a_machine_and_not_each_other(vpn: Lab, guest: Guest) -> None:
    guest.admit()
    machine = vpn.node('machine', 'to:/map', 'from:/one', 'from:/two')
    robot = vpn.node('robot', 'to:/one', 'from:/map', 'from:/two')
    guest.up()
    second = vpn.node('guest', 'to:/two', 'from:/map', 'from:/one')
    for child, topic in ((machine, '/one'), (machine, '/two'), (robot, '/map'),
                         (second, '/map')):
        child.wait('topic', topic, count=5, timeout=60.0)
    assert robot.lines('topic', '/two') == [] and second.lines('topic', '/one') == []


def test_guest_comes_before_the_nodes_of_the_machine(vpn: Lab, guest: Guest) -> None:
    guest.admit()
    guest.up()
    second = vpn.node('guest', 'from:/map')
    vpn.node('machine', 'to:/map')
    second.wait('topic', '/map', count=5, timeout=60.0)
