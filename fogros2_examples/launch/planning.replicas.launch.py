# SPDX-License-Identifier: Apache-2.0
"""Motion planning on three machines: the client gets the plan that comes first."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from fogros2 import ContainerInstance, FogROSLaunchDescription, Replicated
from fogros2_examples.ending import ended


def generate_launch_description():
    """Describe the nodes; ``count:=`` plans, ``environment:=`` is the problem."""
    machines = [ContainerInstance(name=f'planner-{number}') for number in (1, 2, 3)]
    return FogROSLaunchDescription([
        DeclareLaunchArgument('environment', default_value='apartment',
                              description='apartment, cubicles, or a .cfg file of OMPL.app'),
        DeclareLaunchArgument('count', default_value='5',
                              description='how many plans, 0 for ever more'),
        # one search on each machine; the seed makes no difference after the first plan
        Replicated(machines, [
            Node(package='fogros2_examples', executable='motion_planner', output='screen',
                 parameters=[{'workers': 1, 'time': 60.0}])], services=['/plan']),
        Node(package='fogros2_examples', executable='planning_client', output='screen',
             parameters=[{name: ParameterValue(LaunchConfiguration(name), value_type=kind)
                          for name, kind in (('environment', str), ('count', int))}],
             on_exit=ended),
    ])
