# SPDX-License-Identifier: Apache-2.0
"""Two machines at once: a talker on one, a listener on the other, a second listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    """Describe the nodes on three hosts; ``count:=20`` ends the launch after 20 messages."""
    speaker, hearer = (
        ContainerInstance(name=LaunchConfiguration(name), on_exit=LaunchConfiguration('on_exit'),
                          network=LaunchConfiguration('network'))
        for name in ('name', 'second_name'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='speaker',
                              description='what the machine is called'),
        DeclareLaunchArgument('second_name', default_value='hearer',
                              description='what the second machine is called'),
        DeclareLaunchArgument('on_exit', default_value='delete',
                              description='what becomes of them: delete, stop or keep'),
        DeclareLaunchArgument('network', default_value='',
                              description="their network; '' for the engine's own"),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=speaker, package='fogros2_examples', executable='talker',
                  output='screen'),
        CloudNode(machine=hearer, package='fogros2_examples', executable='listener',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', name='robot_listener',
             output='screen', parameters=[{'count': LaunchConfiguration('count')}],
             on_exit=Shutdown()),
    ])
