# SPDX-License-Identifier: Apache-2.0
"""Grasp planning: the planner on ``machine:=``, a depth camera over ten bins on the robot."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from fogros2 import CloudNode, FogMachine, FogROSLaunchDescription
from fogros2_examples.ending import ended
from fogros2_examples.files import checked, PICTURES


def generate_launch_description():
    """Describe the nodes; ``trials:=`` is the number of bins, ``picture:=`` a file to write."""
    return FogROSLaunchDescription([
        DeclareLaunchArgument('machine', default_value='container',
                              choices=['robot', 'container', 'aws', 'kubernetes'],
                              description='where the planner runs'),
        DeclareLaunchArgument('transport', default_value='h264', choices=['h264', 'raw'],
                              description='how depth crosses: h264 is lossless, as is raw'),
        DeclareLaunchArgument('foxglove', default_value='false',
                              description='show the topics in a browser: ros2 fog monitor'),
        DeclareLaunchArgument('trials', default_value='10',
                              description='how many bins, 0 for ever more'),
        DeclareLaunchArgument('picture', default_value='', description='a PNG file to write'),
        checked({}, {'picture': PICTURES}),
        FogMachine(LaunchConfiguration('machine'), {
            'name': 'grasping', 'launch_foxglove': LaunchConfiguration('foxglove')}),
        CloudNode(machine='grasping', package='fogros2_examples', executable='grasp_planner',
                  output='screen', on_exit=ended,
                  stream_topics=[('/depth', LaunchConfiguration('transport'))]),
        Node(package='fogros2_examples', executable='grasp_camera', output='screen',
             parameters=[{name: ParameterValue(LaunchConfiguration(name), value_type=kind)
                          for name, kind in (('trials', int), ('picture', str))}], on_exit=ended),
    ])
