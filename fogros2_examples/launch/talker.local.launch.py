# SPDX-License-Identifier: Apache-2.0
"""The same talker and listener, both here, to compare with the other launch files."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """Describe the nodes; ``count:=20`` ends the launch after 20 messages."""
    return LaunchDescription([
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        Node(package='fogros2_examples', executable='talker', output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
