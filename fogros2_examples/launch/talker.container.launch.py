# SPDX-License-Identifier: Apache-2.0
"""A talker on a container machine of this computer; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import FogROSLaunchDescription
from fogros2_examples.choice import arguments, node


def generate_launch_description():
    """Describe the nodes; ``count:=20`` ends it after 20 messages, ``machine:=local`` is here."""
    return FogROSLaunchDescription([
        *arguments('container', 'talker-machine'),
        *node('talker'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
