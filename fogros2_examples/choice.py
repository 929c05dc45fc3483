# SPDX-License-Identifier: Apache-2.0
"""The launch argument ``machine``: where the talker of the example launch files runs."""

from __future__ import annotations

from typing import Any

from launch import LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, ContainerInstance, SSHInstance


def talker(machine: str, name: str) -> list[LaunchDescriptionEntity]:
    """
    Return the talker and the arguments that say where it runs.

    :param machine: what ``machine:=`` is unless said: container, ssh or local.
    :param name: what the machine is called unless said.
    """
    def argument(argument: str, value: str, description: str) -> DeclareLaunchArgument:
        return DeclareLaunchArgument(argument, default_value=value, description=description)

    def chosen(value: str) -> IfCondition:
        return IfCondition(EqualsSubstitution(LaunchConfiguration('machine'), value))

    program: dict[str, Any] = {'package': 'fogros2_examples', 'executable': 'talker',
                               'output': 'screen'}
    container = ContainerInstance(
        name=LaunchConfiguration('name'), on_exit=LaunchConfiguration('on_exit'))
    computer = SSHInstance(
        host=LaunchConfiguration('host'), user=LaunchConfiguration('user'),
        port=LaunchConfiguration('port'), key=LaunchConfiguration('key'),
        host_key=LaunchConfiguration('host_key'), bootstrap=LaunchConfiguration('bootstrap'),
        on_exit=LaunchConfiguration('on_exit'), name=LaunchConfiguration('name'))
    return [
        DeclareLaunchArgument(
            'machine', default_value=machine, choices=['container', 'ssh', 'local'],
            description='where the talker runs'),
        argument('name', name, 'what the machine is called'),
        argument('on_exit', 'delete', 'what becomes of it: delete, stop or keep'),
        argument('host', '', 'machine:=ssh: name or address of the computer'),
        argument('user', '', 'machine:=ssh: login user there'),
        argument('port', '22', 'machine:=ssh: port of its SSH server'),
        argument('key', '', 'machine:=ssh: private key to log in with'),
        argument('host_key', '', 'machine:=ssh: its public host key; else known_hosts decides'),
        argument('bootstrap', 'auto',
                 'machine:=ssh: how ROS 2 gets there: auto, apt, embedded or none'),
        CloudNode(machine=container, condition=chosen('container'), **program),
        CloudNode(machine=computer, condition=chosen('ssh'), **program),
        Node(condition=chosen('local'), **program),
    ]
