# SPDX-License-Identifier: Apache-2.0
"""A host that several robots share: this computer, behind an SSH server of the test's own."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import glob
import json
import os
from pathlib import Path
import shutil
from typing import Any

from fogros2.model import Command, MachineSpec
from fogros2.process import run
from fogros2.provider.container import machine as container_machine
from fogros2_features.hosts.hosted import HostedProvider
from rigs import networks
from rigs.launched import embedded, Launched
from rigs.sshd import private_sshd, PrivateSshd
from rigs.vpn_lab import PASSED

#: Of TEST-NET-3; several, as two runs of the tests may meet on one computer.
SUBNETS = [f'203.0.113.{host}/27' for host in (0, 96, 128, 160)]
#: What each robot's machine runs: it publishes a map for later subscribers, and a count; and it
#: tells what it hears, and which topics it sees. Its arguments: the robot's name, the map's topic.
NODE = """
import sys
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
robot, topic = sys.argv[1:]
rclpy.init()
node = Node('planner')
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_publisher(String, topic, latched).publish(String(data=f'map of {robot}'))
count, own = node.create_publisher(String, '/count', 10), node.create_publisher(
    String, f'/of_{robot}', 10)
def tell(message):
    print('heard', message.data, flush=True)
# one message for each robot: with a depth of 1, the last of several that come at once is heard
node.create_subscription(String, topic, tell, QoSProfile(
    depth=32, durability=DurabilityPolicy.TRANSIENT_LOCAL))
node.create_subscription(String, '/count', tell, 10)
def tick():
    count.publish(String(data=f'count of {robot}'))
    names = sorted(name for name, _ in node.get_topic_names_and_types() if 'of_' in name)
    print('sees', *names, flush=True)
node.create_timer(0.5, tick)
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    pass
"""
LAUNCH = """
from fogros2 import CloudGroup, ContainerInstance, FogROSLaunchDescription, SSHInstance
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration


def generate_launch_description():
    machine = ContainerInstance(
        name='planner', on=SSHInstance(**{host!r}), network='{network}', share=['{topic}'],
        cpus=0.5, memory='500m', robot_timeout=5, ros_workspace='',
        vpn_path=LaunchConfiguration('vpn_path'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('robot'), DeclareLaunchArgument('vpn_path', default_value='auto'),
        CloudGroup(machine=machine, actions=[
            ExecuteProcess(
                cmd=['python3', '-c', {node!r}, LaunchConfiguration('robot'), '{topic}'],
                output='screen')]),
    ])
"""


class Fleet:
    """
    A host, and what robots do with it.

    :param options: of a machine of the provider 'hosted'.
    """

    def __init__(self, server: PrivateSshd, folder: Path, network: str, address: str) -> None:
        self.on = {'host': address, 'port': server.port, 'host_key': server.host_key,
                   'key': str(server.folder / 'id'), 'user': server.endpoint.user}
        self.options: dict[str, Any] = {'on': self.on, 'network': network}
        self.folder, self.network = folder, network
        self._tokens: set[str] = set()
        # other tests may share topics on this computer
        self.topic = f'/map_{os.urandom(3).hex()}'

    def provider(self) -> HostedProvider:
        """Return a provider that knows the host."""
        made = HostedProvider()
        made.check(MachineSpec('any', 'hosted', self.options))
        return made

    def environment(self, robot: str) -> dict[str, str]:
        """Return the variables of a robot, with a state folder and an id of its own."""
        state = self.folder / robot
        return {**os.environ, 'FOGROS2_STATE_HOME': str(state),
                'XDG_CONFIG_HOME': f'{state}/config', 'ROS_LOG_DIR': f'{state}/log'}

    def launch_file(self, text: str = LAUNCH) -> Path:
        """Write the launch file that all robots have."""
        path = self.folder / 'fleet.launch.py'
        path.write_text(text.format(
            host=self.on, network=self.network, node=NODE, topic=self.topic))
        return path

    def containers(self) -> dict[str, dict[str, Any]]:
        """Return what podman reports of the robots' containers, by their names."""
        names = run(Command((
            'podman', 'ps', '-aq', '--filter=label=fogros2-hosted', '--format',
            '{{.Names}}'), sudo=True), timeout=30.0).stdout.split()
        if not names:
            return {}
        said = run(Command(('podman', 'inspect', *names), sudo=True), timeout=30.0,
                   check=False).stdout
        found = {one['Name']: one for one in json.loads(said or '[]')
                 if self.network in one['NetworkSettings']['Networks']}
        self._tokens |= {one['Config']['Labels'][container_machine.ATTEMPT]
                         for one in found.values()}
        return found

    def shared(self) -> dict[str, str]:
        """Return owner and mode of the folders in which relays write, by container."""
        return {name: run(Command((
            'podman', 'exec', name, 'stat', '-c', '%U %a', '/opt/fogros2/share'), sudo=True),
            timeout=30.0).stdout.strip() for name in self.containers()}

    def traces(self) -> list[str]:
        """Return what is left of machines on the host."""
        tables = run(Command(('nft', 'list', 'tables'), sudo=True), timeout=30.0).stdout
        shared = glob.glob(f'{container_machine.SHARED}/*/*')
        return [*self.containers(), *(
                    path for path in shared if os.path.basename(path) in self._tokens),
                # other tests have machines on this computer, too
                *(line for line in tables.splitlines() if line.partition('fogros2-')[2] in (
                    self._tokens))]


@contextlib.contextmanager
def network() -> Iterator[str]:
    """
    Make a container network whose machines answer others, and reach none of them.

    The engine publishes no ports of an internal network.
    """
    with networks.network(SUBNETS) as (name, subnet):
        rules = f'ip saddr {subnet} ip daddr != {subnet} ct state new drop'
        table = (f'table inet {name} {{ chain out {{ '
                 f'type filter hook forward priority filter - 5; {rules}; }}; }}')
        run(Command(('nft', '-f', '-'), sudo=True, input=table.encode()), timeout=60.0)
        yield name


@contextlib.contextmanager
def fleet(folder: Path, address: str = '127.0.0.1') -> Iterator[Fleet]:
    """
    Have a host for the time of the block.

    :param folder: an empty folder for its files.
    :param address: address of this computer at which robots reach it.
    """
    cache = folder / 'cache'
    # a login of the host knows ROS 2 as this process does, wherever it is
    ros = '' if embedded() else ''.join(
        f' {name}={os.environ[name]}' for name in PASSED if name in os.environ)
    more = f'ListenAddress {address}\nSetEnv SHLVL=2 XDG_CACHE_HOME={cache}{ros}\n'
    with network() as name, private_sshd(folder / 'sshd', more) as server:
        try:
            yield Fleet(server, folder, name, address)
        finally:
            shutil.rmtree(cache, ignore_errors=True)


def heard(launched: Launched, what: str) -> set[str]:
    """Return what a robot's node has printed behind a word."""
    return {line.partition(f'{what} ')[2].strip() for line in list(launched.said)
            if f'] {what} ' in line}
