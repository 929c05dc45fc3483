# SPDX-License-Identifier: Apache-2.0
"""Motion planning: the planner on ``machine:=``, its client on the robot."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from fogros2 import CloudNode, FogMachine, FogROSLaunchDescription
from fogros2_examples.ending import ended
from fogros2_examples.files import checked, PICTURES


def generate_launch_description():
    """Describe the nodes; ``environment:=`` is the problem, ``picture:=`` a file to write."""
    return FogROSLaunchDescription([
        DeclareLaunchArgument('machine', default_value='container',
                              choices=['robot', 'container', 'aws', 'kubernetes'],
                              description='where the planner runs'),
        DeclareLaunchArgument('foxglove', default_value='false',
                              description='show the topics in a browser: ros2 fog monitor'),
        DeclareLaunchArgument('environment', default_value='apartment',
                              description='apartment, cubicles, or a .cfg file of OMPL.app'),
        DeclareLaunchArgument('time', default_value='60.0',
                              description='seconds after which a plan is given up'),
        DeclareLaunchArgument('count', default_value='1',
                              description='how many plans, 0 for ever more'),
        DeclareLaunchArgument('picture', default_value='', description='a PNG file to write'),
        checked({'environment': 'apartment and cubicles are no files'}, {'picture': PICTURES},
                made=('apartment', 'cubicles'),
                readers={'environment': 'fogros2_examples.planning.app_files:loaded'}),
        FogMachine(LaunchConfiguration('machine'), {
            'name': 'planner', 'launch_foxglove': LaunchConfiguration('foxglove')}),
        CloudNode(machine='planner', package='fogros2_examples', executable='motion_planner',
                  output='screen', on_exit=ended, parameters=[
                      {'time': ParameterValue(LaunchConfiguration('time'), value_type=float)}]),
        Node(package='fogros2_examples', executable='planning_client', output='screen',
             parameters=[{name: ParameterValue(LaunchConfiguration(name), value_type=kind)
                          for name, kind in (('environment', str), ('count', int), ('time', float),
                                             ('picture', str))}], on_exit=ended),
    ])
