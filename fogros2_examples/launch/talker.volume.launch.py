# SPDX-License-Identifier: Apache-2.0
"""A talker here; what a listener on a container machine hears stays in the volume 'notes'."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    """Describe the nodes; ``name:=another`` is a new machine with the same volume."""
    machine = ContainerInstance(
        name=LaunchConfiguration('name'), volumes={'notes': '/notes'})
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='listener-machine',
                              description='what the machine is called'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        Node(package='fogros2_examples', executable='talker'),
        CloudNode(machine=machine, package='fogros2_examples', executable='listener',
                  output='screen', parameters=[{'count': LaunchConfiguration('count')}],
                  on_exit=Shutdown(), prefix='sh -c \'"$@" 2>&1 | tee -a /notes/heard.txt\' sh'),
    ])
