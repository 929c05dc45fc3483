# SPDX-License-Identifier: Apache-2.0
"""A talker on an existing computer, reached by SSH; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, FogROSLaunchDescription, SSHInstance


def generate_launch_description():
    """Describe the nodes; ``host:=planner.local user:=robot`` choose the computer."""
    machine = SSHInstance(
        host=LaunchConfiguration('host'), user=LaunchConfiguration('user'),
        key=LaunchConfiguration('key'), host_key=LaunchConfiguration('host_key'),
        name=LaunchConfiguration('name'), bootstrap=LaunchConfiguration('bootstrap'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('host', default_value='',
                              description='name or address of the computer'),
        DeclareLaunchArgument('user', default_value='',
                              description='login user there'),
        DeclareLaunchArgument('key', default_value='',
                              description='private key to log in with'),
        DeclareLaunchArgument('host_key', default_value='',
                              description='its public host key; else known_hosts decides'),
        DeclareLaunchArgument('name', default_value='ssh-machine',
                              description='what the machine is called'),
        DeclareLaunchArgument('bootstrap', default_value='auto',
                              description='how ROS 2 gets there: auto, apt, pip or none'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
