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
    guest.up()
    # the guest's node comes before the nodes of the machine
    second = vpn.node('guest', 'to:/two', 'from:/map', 'from:/one')
    machine = vpn.node('machine', 'to:/map', 'from:/one', 'from:/two')
    robot = vpn.node('robot', 'to:/one', 'from:/map', 'from:/two')
    for child, topic in ((machine, '/one'), (machine, '/two'), (robot, '/map'),
                         (second, '/map')):
        child.wait('topic', topic, count=5, timeout=60.0)
    assert robot.lines('topic', '/two') == [] and second.lines('topic', '/one') == []
    # and another one after them
    vpn.node('guest', 'from:/map').wait('topic', '/map', count=5, timeout=60.0)
