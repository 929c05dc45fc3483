# SPDX-License-Identifier: Apache-2.0
"""Zenoh on a robot with a VPN: real routers and sessions, with the configurations of a launch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import sys
from typing import Optional, TYPE_CHECKING

import pytest

from fogros2.dds.zenoh import Zenoh

if TYPE_CHECKING:
    from rigs.vpn_lab import Child, Lab

pytest.importorskip('zenoh', reason='eclipse-zenoh is not installed')
NODE = Path(__file__).with_name('zenoh_node.py')


class Hosts:
    """Starts routers and sessions on the lab's hosts, as a launch does or without one."""

    def __init__(self, lab: Lab, folder: Path) -> None:
        self.lab = lab
        self.folder = folder
        self.dds = Zenoh()

    def address(self, host: str) -> str:
        return self.lab.interfaces[host].address

    def router(self, host: str, *others: str, user: Optional[Mapping[str, str]] = None) -> Child:
        made = self.dds.router(self.address(host), [self.address(one) for one in others], user)
        assert made is not None
        path = self.folder / f'{host}.router.json5'
        path.write_text(made.config)
        return self._start(host, 'router', **{made.variable: str(path)})

    def node(self, host: str, *words: str) -> Child:
        path = self.folder / f'{host}.json5'
        path.write_text(self.dds.render(self.dds.machine_interfaces(self.address(host)), ()))
        return self._start(host, *words, **self.dds.environment(str(path), {}))

    def stock(self, host: str, *words: str) -> Child:
        """Start what knows nothing of FogROS2."""
        return self._start(host, *words)

    def _start(self, host: str, *words: str, **environment: str) -> Child:
        child = self.lab.start(host, [sys.executable, str(NODE), *words], **environment)
        child.wait('ready', timeout=20.0)
        return child


@pytest.fixture
def hosts(vpn: Lab, tmp_path: Path) -> Hosts:
    return Hosts(vpn, tmp_path)


def test_robot_and_machine_hear_each_other_and_the_lan_goes_on(hosts: Hosts) -> None:
    hosts.lab.lan()
    hosts._start('lan', 'router', ZENOH_ROUTER_CONFIG_URI=_own(hosts, 'lan'))
    # the robot's own, which the user linked with the other computer's
    hosts._start('robot', 'router', ZENOH_ROUTER_CONFIG_URI=_own(
        hosts, 'own', '"tcp/192.168.77.2:7447"'))
    lan = hosts.stock('lan', 'from:/to_lan', 'to:/from_lan')
    terminal = hosts.stock('robot', 'from:/to_lan')
    # the robot's first: it goes on asking for machines that aren't there yet
    hosts.router('robot', 'machine', user={})
    robot = hosts.node('robot', 'to:/up', 'from:/down', 'to:/to_lan', 'from:/from_lan',
                       'to:/local')
    beside = hosts.node('robot', 'from:/local')
    hosts.router('machine')
    machine = hosts.node('machine', 'from:/up', 'to:/down')
    for child, topic in ((machine, '/up'), (robot, '/down'), (beside, '/local'),
                         (lan, '/to_lan'), (robot, '/from_lan'), (terminal, '/to_lan')):
        child.wait('topic', topic, count=3, timeout=15.0)
    assert len(lan.lines('topic', '/up')) == 0


def _own(hosts: Hosts, name: str, endpoint: str = '') -> str:
    path = hosts.folder / f'{name}.json5'
    # the files of shared memory would stay
    path.write_text('{mode: "router", listen: {endpoints: ["tcp/[::]:7447"]},'
                    f' connect: {{endpoints: [{endpoint}]}},'
                    ' transport: {shared_memory: {enabled: false}}}')
    return str(path)


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
    hearer.wait('topic', '/all', count=3, after=since + 0.5, timeout=15.0)
    second.wait('topic', '/over', count=3, after=since + 0.5, timeout=15.0)
