# SPDX-License-Identifier: Apache-2.0
"""A talker on a new EC2 instance; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import AWSCloudInstance, CloudNode, FogROSLaunchDescription


def generate_launch_description():
    """Describe the nodes; ``region:=eu-central-1 spot:=true`` choose the kind of instance."""
    machine = AWSCloudInstance(
        name=LaunchConfiguration('name'), region=LaunchConfiguration('region'),
        ec2_instance_type=LaunchConfiguration('ec2_instance_type'),
        ami_image=LaunchConfiguration('ami_image'), spot=LaunchConfiguration('spot'),
        on_exit=LaunchConfiguration('on_exit'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='talker-aws',
                              description='what the machine is called'),
        DeclareLaunchArgument('region', default_value='',
                              description="AWS region, or 'nearest'; else that of aws configure"),
        DeclareLaunchArgument('ec2_instance_type', default_value='t3.medium',
                              description="type of the instance, or 'cheapest'"),
        DeclareLaunchArgument('ami_image', default_value='',
                              description='its image; else a baked one, or Ubuntu 24.04'),
        DeclareLaunchArgument('spot', default_value='false',
                              description='cheaper, and AWS may take it back'),
        DeclareLaunchArgument('on_exit', default_value='delete',
                              description='what becomes of it: delete, stop or keep'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
