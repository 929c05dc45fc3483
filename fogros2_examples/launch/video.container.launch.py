# SPDX-License-Identifier: Apache-2.0
"""A camera here, image processing on a container machine; both streams of images use H.264."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription, StreamTopic
from fogros2_examples.files import checked


def generate_launch_description():
    """Describe the demo; ``count:=300`` ends it after 300 images."""
    machine = ContainerInstance(name=LaunchConfiguration('name'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='video-machine',
                              description='what the machine is called'),
        DeclareLaunchArgument('source', default_value='synthetic',
                              description="'synthetic', a video file, or a device (/dev/video0)"),
        DeclareLaunchArgument('count', default_value='0',
                              description='images after which the launch ends, 0 for never'),
        checked({'source': 'source:=synthetic takes no camera'}, made=('synthetic',)),
        CloudNode(machine=machine, package='fogros2_examples', executable='image_processor',
                  output='screen', stream_topics=[
                      ('/camera', 'h264'),
                      StreamTopic('/annotated', 'h264', 'to_robot')]),
        Node(package='fogros2_examples', executable='camera', output='screen',
             parameters=[{'source': LaunchConfiguration('source'),
                          'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
