# SPDX-License-Identifier: Apache-2.0
"""A talker in the nearest of the regions that have an image of yours; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import AWSCloudInstance, CloudNode, FogROSLaunchDescription

#: An AMI belongs to one region. Replace these ids by yours; ``ros2 fog image list`` shows them.
IMAGES = {
    'eu-central-1': 'ami-0fedcba9876543210',
    'us-east-1': 'ami-0123456789abcdef0',
}


def generate_launch_description():
    """Describe the nodes; the launch chooses the region, and its image and type."""
    machine = AWSCloudInstance(
        name=LaunchConfiguration('name'), region='nearest', ami_image=IMAGES,
        ec2_instance_type={'eu-central-1': 't3.medium', 'us-east-1': 't3a.medium'})
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='talker-regions',
                              description='what the machine is called'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
