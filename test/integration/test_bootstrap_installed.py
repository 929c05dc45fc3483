# SPDX-License-Identifier: Apache-2.0
"""ROS 2 from its wheels, packed and installed as on a machine."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any, Optional
import zipfile

import pytest

from fogros2 import process
from fogros2.host import bootstrap, wheels
from fogros2.host import inspection as host
from fogros2.host.inspection import HostFacts, Python
from fogros2.host.wheels import Wheels
from fogros2.model import Command, Endpoint, MachineSpec, Result
from fogros2.plan import Underlay
from fogros2.shell.local import LocalShell

TOOLS = frozenset({'ip', 'nft', 'rsync', 'wg', 'wireguard-go', 'apt-get', 'sudo'})
ROS = HostFacts(
    system='ubuntu', release='24.04', architecture='x86_64',
    user='ubuntu', home='/home/ubuntu', libc='glibc 2.39', root=True,
    pythons=(Python('/usr/bin/python3', (3, 12), True),), programs=TOOLS | {'colcon', 'rosdep'},
    free_bytes=50 << 30, ros={'jazzy': '/opt/ros/jazzy'},
    rmw={'jazzy': ('rmw_fastrtps_cpp',)})
UNDER = Underlay(('/robot/.venv',), {
    'PATH': '/robot/.venv/bin:/usr/bin', 'AMENT_PREFIX_PATH': '/robot/.venv',
    'ROS_DISTRO': 'jazzy'})


@pytest.fixture(scope='module')
def packed() -> Wheels:
    """Return the wheels of this installation; only a changed one is packed anew."""
    return wheels.collect()


def test_wheels_hold_this_installation(packed: Wheels) -> None:
    assert packed.python == sys.version_info[:2]
    names = os.listdir(packed.folder)
    assert packed.fogros2 in names
    assert (packed.pip in names) == packed.ros  # a machine with ROS 2 has its own
    assert not [name for name in names if name.startswith(('paramiko', 'pytest', 'mypy'))]
    if packed.ros:
        assert [name for name in names if name.startswith('ros_rclpy')]
        # a library that several distributions bring is sent once, and no header
        files = [file for name in names if name.endswith('.whl')
                 for file in zipfile.ZipFile(Path(packed.folder, name)).namelist()]
        assert len([file for file in files if '/libcrypto-' in file]) == 1
        assert not [file for file in files if file.endswith(('.h', '.hpp', '.cmake'))
                    and not file.startswith(('numpy', 'ros2_embedded'))]


def test_ros_is_installed_without_a_network(
    packed: Wheels, tmp_path: Path,
) -> None:
    if not packed.ros:
        pytest.skip('this interpreter has an installation of ROS 2 and no wheels of it')
    facts = dataclasses.replace(
        host.parse_facts(process.run(host.probe(), timeout=30).stdout), home=str(tmp_path),
        pythons=(Python(sys.executable, sys.version_info[:2], True),),
        programs=TOOLS)
    spec = MachineSpec('m', 'ssh', bootstrap='pip')
    todo = bootstrap.plan(spec, facts, facts, UNDER, packed)
    assert todo.mode == 'pip'
    target = Path(todo.wheels_target)
    target.mkdir(parents=True)
    subprocess.run(['cp', '-r', f'{packed.folder}/.', str(target)], check=True)
    offline = ['unshare', '-n'] if os.geteuid() == 0 else []
    environment = {'PATH': '/usr/bin:/bin', 'HOME': str(tmp_path),
                   'PIP_INDEX_URL': 'http://127.0.0.1:9/'}
    for command in todo.commands:
        subprocess.run([*offline, *command.argv], check=True, env=environment)
    python = f'{target.parent}/venv/bin/python'
    said = subprocess.run(
        [python, '-c', 'import fogros2, rclpy, launch, std_msgs.msg as m; rclpy.init(); '
         'node = rclpy.create_node("n"); node.create_publisher(m.String, "t", 1); '
         'print(fogros2.__file__)'],
        check=True, capture_output=True, text=True, env=environment, cwd=tmp_path).stdout
    assert str(tmp_path) in said
    ros2 = Path(todo.install.environment['AMENT_PREFIX_PATH'], 'bin/ros2')
    assert subprocess.run([ros2, 'fog', '-h'], check=True, capture_output=True, text=True,
                          env=environment).stdout
    # the next launch sees it and has nothing to do
    facts = dataclasses.replace(facts, installed=frozenset({target.parent.name}))
    assert bootstrap.plan(spec, facts, facts, UNDER, packed).commands == ()


def other_python() -> Optional[Python]:
    """Return an interpreter for which there are wheels of ROS 2, and which is not this one."""
    for path in [os.environ.get('FOGROS2_OTHER_PYTHON', ''), *(
            f'python3.{minor}' for minor in range(10, 15) if minor != sys.version_info[1])]:
        done = path and shutil.which(path) and subprocess.run(
            [path, '-c', 'import sys, venv, ssl; print(sys.executable, sys.version_info[1])'],
            capture_output=True, text=True)
        if done and done.returncode == 0:
            executable, minor = done.stdout.split()
            return Python(executable, (3, int(minor)), True)
    return None


class Machine(LocalShell):
    """This computer as a machine: another home and Python, and no network."""

    def __init__(self, home: Path, python: Python) -> None:
        super().__init__(Endpoint('local'), name='m')
        self.home, self.python = home, python

    def run(self, command: Command, **options: Any) -> Result:
        if command.argv[-1:] != ('probe',) and command.what != 'look at the machine':
            words = ('unshare', '-n', 'env', f'HOME={self.home}', *command.argv)
            return super().run(dataclasses.replace(command, argv=words), **options)
        text = super().run(command, **options).stdout
        kept = [line for line in text.splitlines() if line.split(' ')[0] not in (
            'python', 'home', 'ros', 'rmw', 'environment', 'fogros2', 'installed')]
        return Result(0, '\n'.join([
            *kept, f'home {self.home}',
            f'python 3 {self.python.version[1]} 1 {self.python.path}']), '')


def test_machine_with_another_python_gets_ros(packed: Wheels, tmp_path: Path) -> None:
    """From the robot's package index: the machine reaches none."""
    python = other_python()
    if not packed.ros or python is None or os.geteuid() != 0:
        pytest.skip('needs root, and another Python from 3.10 to 3.14 (FOGROS2_OTHER_PYTHON)')
    install, note = bootstrap.ensure(
        Machine(tmp_path, python), UNDER, MachineSpec('m', 'ssh', bootstrap='pip'),
        timeout=500)
    assert note == 'ROS 2 installed by pip'
    talk = ('import rclpy, std_msgs.msg as m; rclpy.init(); node = rclpy.create_node("n"); '
            'node.create_publisher(m.String, "t", 1).publish(m.String(data="x")); print("done")')
    assert subprocess.run(
        [Path(install.environment['VIRTUAL_ENV'], 'bin/python'), '-c', talk], check=True,
        text=True, capture_output=True, env={'HOME': str(tmp_path)}).stdout == 'done\n'


def test_fogros2_is_unpacked_beside_a_ros_that_is_there(packed: Wheels, tmp_path: Path) -> None:
    facts = dataclasses.replace(ROS, home=str(tmp_path))
    todo = bootstrap.plan(MachineSpec('m', 'ssh'), facts, facts, UNDER, packed)
    target = Path(todo.wheels_target)
    target.mkdir(parents=True)
    subprocess.run(['cp', '-r', f'{packed.folder}/.', str(target)], check=True)
    for command in todo.commands:
        process.run(command, timeout=60)
    prefix = Path(todo.install.environment['AMENT_PREFIX_PATH'].split(os.pathsep)[0])
    assert (prefix / 'share/ament_index/resource_index/packages/fogros2_examples').exists()
    assert os.access(prefix / 'lib/fogros2_examples/talker', os.X_OK)
