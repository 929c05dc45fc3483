# SPDX-License-Identifier: Apache-2.0
"""A talker on an existing computer, reached by SSH; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import FogROSLaunchDescription
from fogros2_examples.choice import arguments, node


def generate_launch_description():
    """Describe the nodes; ``host:=planner.local user:=robot`` choose the computer."""
    return FogROSLaunchDescription([
        *arguments('ssh', 'ssh-machine'),
        *node('talker'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
