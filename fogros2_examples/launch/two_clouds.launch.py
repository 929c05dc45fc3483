# SPDX-License-Identifier: Apache-2.0
"""Two machines at once: a talker on one, a listener on the other, a second listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import FogROSLaunchDescription
from fogros2_examples.choice import arguments, node, SECOND


def generate_launch_description():
    """Describe the nodes on three hosts; ``count:=20`` ends the launch after 20 messages."""
    return FogROSLaunchDescription([
        *arguments('container', 'speaker', 'hearer'),
        *node('talker'),
        *node('listener', which=SECOND),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        Node(package='fogros2_examples', executable='listener', name='robot_listener',
             output='screen', parameters=[{'count': LaunchConfiguration('count')}],
             on_exit=Shutdown()),
    ])
