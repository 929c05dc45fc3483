# SPDX-License-Identifier: Apache-2.0
"""A talker and a listener, whose machines together cost a budget at most; containers cost none."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    """Describe the nodes; ``--machine '*=aws'`` runs them at AWS."""
    speaker, hearer = (
        ContainerInstance(name=[LaunchConfiguration('name'), end],
                          launch_budget=LaunchConfiguration('budget'))
        for end in ('-speaker', '-hearer'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='thrifty',
                              description='how the names of the machines begin'),
        DeclareLaunchArgument('budget', default_value='0.5 USD',
                              description='the most that both machines cost'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=speaker, package='fogros2_examples', executable='talker',
                  output='screen'),
        CloudNode(machine=hearer, package='fogros2_examples', executable='listener',
                  output='screen', parameters=[{'count': LaunchConfiguration('count')}],
                  on_exit=Shutdown()),
    ])
