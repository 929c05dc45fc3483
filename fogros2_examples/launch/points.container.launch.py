# SPDX-License-Identifier: Apache-2.0
"""A lidar here, a search for obstacles on a container machine; both point clouds are streamed."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription, StreamTopic


def generate_launch_description():
    """Describe the demo; ``count:=300`` ends it after 300 scans."""
    machine = ContainerInstance(name=LaunchConfiguration('name'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='points-machine',
                              description='what the machine is called'),
        DeclareLaunchArgument('count', default_value='0',
                              description='scans after which the launch ends, 0 for never'),
        CloudNode(machine=machine, package='fogros2_examples', executable='obstacle_finder',
                  output='screen', stream_topics=[
                      StreamTopic('/points', 'pointcloud', resolution=0.01),
                      StreamTopic('/obstacles', 'pointcloud', 'to_robot')]),
        Node(package='fogros2_examples', executable='lidar', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
