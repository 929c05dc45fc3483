# SPDX-License-Identifier: Apache-2.0
"""Zenoh on a robot with a VPN: real routers and sessions, with the configurations of a launch."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigs.vpn_lab import Lab
from rigs.zenoh_hosts import Hosts

pytest.importorskip('zenoh', reason='eclipse-zenoh is not installed')
@pytest.fixture
def hosts(vpn: Lab, tmp_path: Path) -> Hosts:
    return Hosts(vpn, tmp_path)


def test_robot_and_machine_hear_each_other_and_the_lan_goes_on(hosts: Hosts) -> None:
    hosts.lab.lan()
    hosts.users_router('lan')
    # the robot's own, which the user linked with the other computer's
    hosts.users_router('robot', '"tcp/192.168.77.2:7447"')
    lan = hosts.stock('lan', 'from:/to_lan', 'to:/from_lan')
    terminal = hosts.stock('robot', 'from:/to_lan')
    # the robot's first: it goes on asking for machines that aren't there yet
    hosts.router('robot', 'machine', user={'ROS_STATIC_PEERS': '127.0.0.1'})
    robot = hosts.node('robot', 'to:/up', 'from:/down', 'to:/to_lan', 'from:/from_lan',
                       'to:/local')
    beside = hosts.node('robot', 'from:/local')
    hosts.router('machine')
    machine = hosts.node('machine', 'from:/up', 'to:/down')
    for child, topic in ((machine, '/up'), (robot, '/down'), (beside, '/local'),
                         (lan, '/to_lan'), (robot, '/from_lan'), (terminal, '/to_lan')):
        child.wait('topic', topic, count=3, timeout=60.0)
    assert len(lan.lines('topic', '/up')) == 0


def test_machines_hear_each_other_and_a_router_may_die(hosts: Hosts) -> None:
    hosts.lab.second()
    hosts.router('robot', 'machine', 'second', user={'ROS_LOCALHOST_ONLY': '1'})
    first = hosts.router('machine')
    hosts.router('second', 'machine')
    hearer = hosts.node('robot', 'from:/all')
    hosts.node('machine', 'to:/over', 'to:/all')
    second = hosts.node('second', 'from:/over')
    second.wait('topic', '/over', count=3)
    hearer.wait('topic', '/all', count=3)
    first.stop()
    hosts.router('machine')
    since = hearer.lines('topic', '/all')[-1]['arrival']
    hearer.wait('topic', '/all', count=3, after=since + 0.5, timeout=60.0)
    second.wait('topic', '/over', count=3, after=since + 0.5, timeout=60.0)
