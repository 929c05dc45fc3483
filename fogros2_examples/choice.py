# SPDX-License-Identifier: Apache-2.0
"""Declare the launch argument ``machine``: where the cloud nodes of the example launches run."""

from __future__ import annotations

from typing import Any

from launch import LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration

from fogros2 import ContainerInstance, Node, SSHInstance

#: Prefix of the arguments for the second machine.
SECOND = 'second_'


def argument(name: str, value: str, description: str) -> DeclareLaunchArgument:
    """Return a launch argument with a default."""
    return DeclareLaunchArgument(name, default_value=value, description=description)


def arguments(machine: str, name: str, second: str = '') -> list[DeclareLaunchArgument]:
    """
    Return the launch arguments that choose the machines.

    :param machine: default of ``machine:=``: container, ssh or local.
    :param name: default name of the machine.
    :param second: default name of the second machine; '': there is none.
    """
    arguments = [
        DeclareLaunchArgument(
            'machine', default_value=machine, choices=['container', 'ssh', 'local'],
            description='where the cloud nodes run'),
        argument('name', name, 'what the machine is called'),
        argument('on_exit', 'delete', 'what becomes of it: delete, stop or keep'),
        argument('vpn_path', '', "how the VPN's packets travel: udp, stream or, usually, auto"),
        argument('network', '', "machine:=container: its network; '' for the engine's own"),
        argument('host', '', 'machine:=ssh: name or address of the computer'),
        argument('user', '', 'machine:=ssh: login user there'),
        argument('port', '0', 'machine:=ssh: port of its SSH server; 0: as ssh chooses it'),
        argument('key', '', 'machine:=ssh: private key to log in with'),
        argument('host_key', '', 'machine:=ssh: its public host key; else known_hosts decides'),
        argument('bootstrap', 'auto',
                 'machine:=ssh: how ROS 2 gets there: auto, apt, pip or none'),
    ]
    if second:
        arguments += [
            argument(f'{SECOND}name', second, 'what the second machine is called'),
            argument(f'{SECOND}host', '', 'machine:=ssh: the second computer'),
            argument(f'{SECOND}host_key', '', 'machine:=ssh: its public host key'),
        ]
    return arguments


def node(executable: str, *, which: str = '', **kwargs: Any) -> list[LaunchDescriptionEntity]:
    """
    Return a node of this package on the machine that ``machine:=`` chooses, or on the robot.

    :param which: the machine: '' for the first, ``SECOND`` for the second.
    :param kwargs: further arguments of launch_ros's Node.
    """
    def chosen(value: str) -> IfCondition:
        return IfCondition(EqualsSubstitution(LaunchConfiguration('machine'), value))

    def own(argument: str) -> LaunchConfiguration:
        return LaunchConfiguration(f'{which}{argument}')

    common: dict[str, Any] = {'name': own('name'), **{
        word: LaunchConfiguration(word) for word in ('on_exit', 'vpn_path')}}
    container = ContainerInstance(network=LaunchConfiguration('network'), **common)
    computer = SSHInstance(
        host=own('host'), user=LaunchConfiguration('user'), port=LaunchConfiguration('port'),
        key=LaunchConfiguration('key'), host_key=own('host_key'),
        bootstrap=LaunchConfiguration('bootstrap'), **common)
    program: dict[str, Any] = {'package': 'fogros2_examples', 'executable': executable,
                               'output': 'screen', **kwargs}
    return [
        Node(machine=container, condition=chosen('container'), **program),
        Node(machine=computer, condition=chosen('ssh'), **program),
        Node(condition=chosen('local'), **program),
    ]
