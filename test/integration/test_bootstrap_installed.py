# SPDX-License-Identifier: Apache-2.0
"""The embedded default, packed as wheels and installed as on a machine."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
import subprocess
import sys

import pytest

from fogros2 import process
from fogros2.host import bootstrap, wheels
from fogros2.host import inspection as host
from fogros2.host.inspection import HostFacts, Python
from fogros2.host.wheels import Wheels
from fogros2.model import MachineSpec
from fogros2.plan import Underlay

TOOLS = frozenset({'ip', 'nft', 'rsync', 'wg', 'wireguard-go', 'apt-get', 'sudo'})
ROS = HostFacts(
    system='ubuntu', release='24.04', architecture='x86_64', uid=1000,
    user='ubuntu', home='/home/ubuntu', libc='glibc 2.39', root=True,
    pythons=(Python('/usr/bin/python3', (3, 12), True),), programs=TOOLS | {'colcon', 'rosdep'},
    free_bytes=50 << 30, ros={'jazzy': '/opt/ros/jazzy'},
    rmw={'jazzy': ('rmw_cyclonedds_cpp',)})
UNDER = Underlay(('/robot/.venv',), '/robot/.venv/bin/ros2', {
    'PATH': '/robot/.venv/bin:/usr/bin', 'AMENT_PREFIX_PATH': '/robot/.venv',
    'ROS_DISTRO': 'jazzy'})


@pytest.fixture(scope='module')
def packed(tmp_path_factory: pytest.TempPathFactory) -> Wheels:
    folder = tmp_path_factory.mktemp('wheels')
    first = wheels.collect(folder)
    # the second time everything is there
    assert wheels.collect(folder) == first
    return first


def test_wheels_hold_this_installation(packed: Wheels) -> None:
    assert packed.python == sys.version_info[:2]
    names = os.listdir(packed.folder)
    assert packed.fogros2 in names
    assert (packed.pip in names) == packed.embedded  # a machine with ROS 2 has its own
    assert not [name for name in names if name.startswith(('paramiko', 'pytest', 'mypy'))]
    if packed.embedded:
        assert [name for name in names if name.startswith('cyclonedds')]


def test_the_embedded_default_is_installed_without_a_network(
    packed: Wheels, tmp_path: Path,
) -> None:
    if not packed.embedded:
        pytest.skip('this interpreter has ROS 2 and no embedded default to send')
    facts = dataclasses.replace(
        host.parse_facts(process.run(host.probe(), timeout=30).stdout), home=str(tmp_path),
        pythons=(Python(sys.executable, sys.version_info[:2], True),),
        programs=TOOLS)
    spec = MachineSpec('m', 'ssh', bootstrap='embedded')
    todo = bootstrap.plan(spec, facts, facts, UNDER, packed)
    assert todo.mode == 'embedded'
    target = Path(todo.wheels_target)
    target.mkdir(parents=True)
    subprocess.run(['cp', '-r', f'{packed.folder}/.', str(target)], check=True)
    offline = ['unshare', '-n'] if os.geteuid() == 0 else []
    environment = {'PATH': '/usr/bin:/bin', 'HOME': str(tmp_path),
                   'PIP_INDEX_URL': 'http://127.0.0.1:9/'}
    for command in todo.commands:
        subprocess.run([*offline, *command.argv], check=True, env=environment)
    python = f'{tmp_path}/.local/share/fogros2/{packed.key}/venv/bin/python'
    said = subprocess.run(
        [python, '-c', 'import fogros2, rclpy, launch, std_msgs.msg; print(fogros2.__file__)'],
        check=True, capture_output=True, text=True, env=environment, cwd=tmp_path).stdout
    assert str(tmp_path) in said
    assert Path(todo.install.command[-1]).is_file()
    ros2 = Path(todo.install.command[0])
    assert subprocess.run([ros2, 'fog', '-h'], check=True, capture_output=True, text=True,
                          env=environment).stdout
    # the next launch sees it and has nothing to do
    facts = dataclasses.replace(facts, installed=frozenset({packed.key}))
    assert bootstrap.plan(spec, facts, facts, UNDER, packed).commands == ()


def test_fogros2_is_unpacked_beside_a_ros_that_is_there(packed: Wheels, tmp_path: Path) -> None:
    facts = dataclasses.replace(ROS, home=str(tmp_path))
    todo = bootstrap.plan(MachineSpec('m', 'ssh'), facts, facts, UNDER, packed)
    target = Path(todo.wheels_target)
    target.mkdir(parents=True)
    subprocess.run(['cp', '-r', f'{packed.folder}/.', str(target)], check=True)
    for command in todo.commands:
        process.run(command, timeout=60)
    assert Path(todo.install.command[-1]).is_file()
    prefix = Path(todo.install.environment['AMENT_PREFIX_PATH'])
    assert (prefix / 'share/ament_index/resource_index/packages/fogros2_examples').exists()
    assert os.access(prefix / 'lib/fogros2_examples/talker', os.X_OK)
