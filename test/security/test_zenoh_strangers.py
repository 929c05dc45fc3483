# SPDX-License-Identifier: Apache-2.0
"""A hijacked machine and the user's other nodes, where nodes use zenoh."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigs.vpn_lab import Lab
from rigs.zenoh_hosts import Hosts

pytest.importorskip('zenoh', reason='eclipse-zenoh is not installed')


def test_machine_meets_the_launch_s_nodes_alone(vpn: Lab, tmp_path: Path) -> None:
    """The user runs a router on the robot, and one on another computer of the LAN."""
    hosts = Hosts(vpn, tmp_path)
    vpn.lan()
    hosts.users_router('lan')
    hosts.users_router('robot', '"tcp/192.168.77.2:7447"')
    lan = hosts.stock('lan', 'to:/lan', 'from:/other', 'from:/machine')
    other = hosts.stock('robot', 'to:/other', 'from:/lan', 'from:/machine')
    hosts.router('robot', 'machine', user={})
    hosts.router('machine')
    robot = hosts.node('robot', 'to:/robot', 'from:/machine')
    machine = hosts.node('machine', 'to:/machine', 'from:/robot', 'from:/lan', 'from:/other')
    for child, topic in ((lan, '/other'), (other, '/lan'), (robot, '/machine'),
                         (machine, '/robot')):
        child.wait('topic', topic, count=20, timeout=60.0)
    for child, topic in ((machine, '/lan'), (machine, '/other'),
                         (lan, '/machine'), (other, '/machine')):
        assert child.lines('topic', topic) == [], topic
