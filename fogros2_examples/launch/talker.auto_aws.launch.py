# SPDX-License-Identifier: Apache-2.0
"""A talker in the nearest AWS region, on the cheapest suitable instance; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import AWSCloudInstance, CloudNode, FogROSLaunchDescription


def generate_launch_description():
    """Describe the nodes; the launch chooses region and type when it runs."""
    machine = AWSCloudInstance(
        name=LaunchConfiguration('name'), region='nearest', ec2_instance_type='cheapest',
        min_cpu=LaunchConfiguration('min_cpu'), min_memory_gb=LaunchConfiguration('min_memory'),
        max_price=LaunchConfiguration('max_price'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='talker-auto',
                              description='what the machine is called'),
        DeclareLaunchArgument('min_cpu', default_value='2',
                              description='vCPUs that it has at the least'),
        DeclareLaunchArgument('min_memory', default_value='4',
                              description='GiB of memory that it has at the least'),
        DeclareLaunchArgument('max_price', default_value='0.10',
                              description='US dollars an hour that it costs at the most'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
