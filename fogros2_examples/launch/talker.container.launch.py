# SPDX-License-Identifier: Apache-2.0
"""A talker on a container machine of this computer; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    """Describe the nodes; ``count:=20`` ends the launch after 20 messages."""
    machine = ContainerInstance(
        name=LaunchConfiguration('name'), on_exit=LaunchConfiguration('on_exit'),
        network=LaunchConfiguration('network'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='talker-machine',
                              description='what the machine is called'),
        DeclareLaunchArgument('on_exit', default_value='delete',
                              description='what becomes of it: delete, stop or keep'),
        DeclareLaunchArgument('network', default_value='',
                              description="its network; '' for the engine's own"),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
