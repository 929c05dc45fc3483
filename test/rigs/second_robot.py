# SPDX-License-Identifier: Apache-2.0
"""
A second robot on this computer: a network namespace behind a NAT of its own.

::

    this computer 203.0.113.193 --- .194  NAT  192.168.78.1 --- .2  second robot

Each has four addresses of its own, so that several tests run beside one another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import json
import os
from pathlib import Path
import subprocess

import pytest

from fogros2.model import Command
from fogros2.process import argv, run
from fogros2.store import Store
from rigs import domains
from rigs.launched import Launched, launching

#: How many there are at a time: 203.0.113.192/26 has so many networks of four addresses.
ROBOTS = 16
#: No packet of another connection comes in, as with a home's router.
NAT = """\
table inet nat {
    chain forward { type filter hook forward priority filter; policy drop;
        iifname "in" accept
        ct state established,related accept
    }
    chain postrouting { type nat hook postrouting priority srcnat; oifname "out" masquerade; }
}
"""
#: A launch file of its own, with a talker on a machine by an invitation.
LAUNCH = """
from launch_ros.actions import Node

from fogros2 import CloudNode, FogROSLaunchDescription, JoinedMachine


def generate_launch_description():
    machine = JoinedMachine('{text}', name='theirs', ros_workspace='{workspace}',
                            robot_timeout=10)
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen', remappings=[('chatter', '/near')]),
        *[CloudNode(machine=machine, package='own', executable='where', output='screen')]
        * bool('{workspace}'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             remappings=[('chatter', '/near')])])
"""


class SecondRobot:
    """
    A computer with its own network, state folder and processes.

    :param number: below ``ROBOTS``, another one for each.
    """

    def __init__(self, state: Path, number: int) -> None:
        self.host, self.nat_address = (f'203.0.113.{192 + 4 * number + end}' for end in (1, 2))
        mark = f'fogs{os.getpid() % 10000}{number:02}'
        self.spaces = [f'{mark}n', f'{mark}r']
        #: Words before those of a program there. `ip netns exec` hides the control groups of this
        #: computer, and without them a launch does not filter its DDS.
        self.enter = ('ip', 'netns', 'exec', self.spaces[1], 'sh', '-c',
                      'mount -t cgroup2 cgroup2 /sys/fs/cgroup; exec "$@"', 'sh')
        self.environment = {
            **os.environ, 'FOGROS2_STATE_HOME': str(state), 'XDG_CONFIG_HOME': f'{state}/config',
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}

    def open(self) -> None:
        nat, robot = self.spaces
        for space in self.spaces:
            self.ip('netns', 'add', space)
            self.ip('-n', space, 'link', 'set', 'lo', 'up')
        self.ip('link', 'add', nat, 'type', 'veth', 'peer', 'name', 'out', 'netns', nat)
        self.ip('address', 'add', f'{self.host}/30', 'dev', nat)
        self.ip('link', 'set', nat, 'up')
        self.ip('link', 'add', 'in', 'netns', nat, 'type', 'veth',
                'peer', 'name', 'e0', 'netns', robot)
        for space, name, address in (
                (nat, 'out', f'{self.nat_address}/30'), (nat, 'in', '192.168.78.1/24'),
                (robot, 'e0', '192.168.78.2/24')):
            self.ip('-n', space, 'address', 'add', address, 'dev', name)
            self.ip('-n', space, 'link', 'set', name, 'up')
        self.ip('-n', nat, 'route', 'add', 'default', 'via', self.host)
        self.ip('-n', robot, 'route', 'add', 'default', 'via', '192.168.78.1')
        run(Command(('ip', 'netns', 'exec', nat, 'sh', '-ec',
                     'echo 1 >/proc/sys/net/ipv4/ip_forward; nft -f -'), sudo=True,
                    input=NAT.encode()), timeout=60.0)

    def reaches(self, engine: str, network: str) -> str:
        """Let packets pass between this robot and a network of the tests; return its gateway."""
        said = json.loads(run(Command((engine, 'network', 'inspect', network), sudo=True),
                              timeout=30.0).stdout)[0]
        # this computer forwards nothing from there
        for link in (said['network_interface'], self.spaces[0]):
            run(Command.script(f'echo 1 >/proc/sys/net/ipv4/conf/{link}/forwarding', sudo=True),
                timeout=60.0)
        shown = json.loads(run(Command((
            'ip', '-json', '-4', 'address', 'show', said['network_interface'])),
            timeout=60.0).stdout)
        return str(shown[0]['addr_info'][0]['local'])

    def close(self) -> None:
        for name in Store(Path(self.environment['FOGROS2_STATE_HOME'])).other_vpns():
            self.run('ros2', 'fog', 'leave', name)
        for words in (('link', 'delete', self.spaces[0]),
                      *(('netns', 'delete', space) for space in self.spaces)):
            run(Command(('ip', *words), sudo=True), timeout=60.0, check=False)

    def ip(self, *words: str) -> None:
        run(Command(('ip', *words), sudo=True), timeout=60.0)

    def start(self, *words: str) -> subprocess.Popen[str]:
        """Start a program there; its output is read by the caller."""
        return subprocess.Popen(
            argv(Command((*self.enter, *words), sudo=True)),
            env=self.environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True)

    def run(self, *words: str, status: int = 0, timeout: float = 60.0) -> str:
        """Return what a program there prints: its output, or its errors if it has to fail."""
        child = self.start(*words)
        try:
            out, errors = child.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            child.kill()
            out, errors = child.communicate()
        assert child.returncode == status, f'{words}: {child.returncode}\n{out}{errors}'
        return errors if status else out


@pytest.fixture
def second(tmp_path: Path, tun: None) -> Iterator[SecondRobot]:
    if os.getuid():
        pytest.skip('needs root itself: sudo, the way into the second robot, keeps no variables')
    with domains.number('second-robot', ROBOTS) as number:
        robot = SecondRobot(tmp_path / 'second', number)
        try:
            robot.open()
            yield robot
        finally:
            robot.close()


@pytest.fixture
def join(second: SecondRobot, tmp_path: Path) -> Iterator[Callable[..., Launched]]:
    """Return what launches on the second robot with an invitation and a workspace's folder."""
    with launching() as start:
        def launch(text: str, workspace: str = '') -> Launched:
            path = tmp_path / 'second.launch.py'
            path.write_text(LAUNCH.format(text=text, workspace=workspace))
            return start(str(path), environment=second.environment, prefix=second.enter)
        yield launch
