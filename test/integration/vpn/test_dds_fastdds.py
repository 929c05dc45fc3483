# SPDX-License-Identifier: Apache-2.0
"""
Fast DDS on a robot with a VPN: its own library reads the profiles and finds the other side.

A small program takes a node's place, with Debian's library (2.9) and with ROS 2 Jazzy's (2.14).
"""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import subprocess
from typing import TYPE_CHECKING

import pytest

from fogros2.dds.fastdds import FastDds
from fogros2.model import DdsInterface

if TYPE_CHECKING:
    from rigs.vpn_lab import Child, Lab

SOURCE = Path(__file__).with_name('fastdds_node.cpp')




def ros_prefix() -> Path | None:
    """Return where ROS 2 has its own Fast DDS."""
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if prefix and Path(prefix, 'include/fastdds').is_dir():
            return Path(prefix)
    return None


@pytest.fixture(scope='module', params=['debian', 'ros'])
def program(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the node's program, compiled."""
    compiler = shutil.which('g++')
    flags: list[str] = []
    if request.param == 'ros':
        prefix = ros_prefix()
        if prefix is None:
            pytest.skip('needs ROS 2 with Fast DDS')
        flags = [f'-I{prefix}/include', f'-L{prefix}/lib',
                 f'-Wl,--disable-new-dtags,-rpath,{prefix}/lib']
    elif not Path('/usr/include/fastdds').is_dir():
        pytest.skip('this computer has no Fast DDS to compile with (libfastrtps-dev)')
    if compiler is None:
        pytest.skip('needs g++')
    made = tmp_path_factory.mktemp('fastdds') / 'fastdds_node'
    subprocess.run([compiler, '-std=c++17', *flags, str(SOURCE), '-o', str(made), '-lfastrtps',
                    '-lfastcdr'], check=True)
    return made


class Nodes:
    """Starts nodes on the lab's hosts, with a profile or without one."""

    def __init__(self, lab: Lab, program: Path, folder: Path) -> None:
        self.lab = lab
        self.program = program
        self.folder = folder
        self.dds = FastDds()

    def start(self, host: str, *words: str, profile: str = '') -> Child:
        environment = {}
        if profile:
            path = self.folder / f'{host} {len(self.lab.children)}.xml'
            path.write_text(profile)
            environment = dict(self.dds.environment(str(path), {}))
        child = self.lab.start(host, [str(self.program), *words], **environment)
        child.wait('ready')
        return child

    def robot(self, *words: str) -> Child:
        """Start a node as a launch on the robot does."""
        return self.start('robot', *words, profile=self.dds.render(
            self.dds.robot_interfaces(self.lab.interfaces['robot'].name, None, {}), ()))

    def machine(self, *words: str, host: str = 'machine', peers: tuple[str, ...] = (),
                multicast: bool = True) -> Child:
        interface = DdsInterface(self.lab.interfaces[host].name, multicast=multicast)
        return self.start(host, *words, profile=self.dds.render([interface], peers))


@pytest.fixture
def nodes(vpn: Lab, program: Path, tmp_path: Path) -> Nodes:
    return Nodes(vpn, program, tmp_path)


def test_robot_and_machine_hear_each_other_and_the_lan_goes_on(nodes: Nodes) -> None:
    nodes.lab.lan()
    lan = nodes.start('lan', 'from:/to_lan', 'to:/from_lan')
    machine = nodes.machine('from:/up', 'to:/down')
    robot = nodes.robot('to:/up', 'from:/down', 'to:/to_lan', 'from:/from_lan', 'to:/local')
    beside = nodes.robot('from:/local')
    terminal = nodes.start('robot', 'from:/to_lan')
    for child, topic in ((machine, '/up'), (robot, '/down'), (beside, '/local'),
                         (lan, '/to_lan'), (robot, '/from_lan'), (terminal, '/to_lan')):
        child.wait('topic', topic, count=3)


def test_a_robot_with_many_addresses_is_heard(
    nodes: Nodes, request: pytest.FixtureRequest,
) -> None:
    if request.node.callspec.params['program'] == 'debian':
        pytest.skip('Fast DDS 2.9 keeps four addresses, whatever its profile says')
    for number in range(81, 86):
        # as containers' bridges bring them: more addresses than Fast DDS keeps by default
        nodes.lab.ip('-n', nodes.lab.spaces['robot'], 'address', 'add',
                     f'192.168.{number}.1/24', 'dev', 'e0')
    machine = nodes.machine('from:/up', 'to:/down')
    robot = nodes.robot('to:/up', 'from:/down')
    machine.wait('topic', '/up', count=3)
    robot.wait('topic', '/down', count=3)


def test_unicast_alone_finds_the_other_side(nodes: Nodes) -> None:
    for host in ('robot', 'machine'):
        nodes.lab.ip('-n', nodes.lab.spaces[host], 'link', 'set', nodes.lab.interfaces[host].name,
                     'multicast', 'off')
    robot = nodes.robot('to:/up', 'from:/down')
    machine = nodes.machine('from:/up', 'to:/down', multicast=False, peers=(
        nodes.lab.interfaces['robot'].address,))
    machine.wait('topic', '/up', count=3)
    robot.wait('topic', '/down', count=3)


def test_machines_find_each_other(nodes: Nodes, request: pytest.FixtureRequest) -> None:
    if request.node.callspec.params['program'] == 'debian':
        # they met by multicast outside of the VPN, which machines do not take
        pytest.skip('Fast DDS 2.9 asks no peers where a profile has netmask_filter')
    nodes.lab.second()
    addresses = {host: one.address for host, one in nodes.lab.interfaces.items()}
    first = nodes.machine('to:/over', peers=(addresses['second'],))
    second = nodes.machine('from:/over', host='second', peers=(addresses['machine'],))
    second.wait('topic', '/over', count=3)
    del first
