# SPDX-License-Identifier: Apache-2.0
"""A talker on a container machine; at the end, a recording of it comes home."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    """Describe the node; Ctrl-C ends it."""
    machine = ContainerInstance(
        name=LaunchConfiguration('name'), network=LaunchConfiguration('network'),
        record=['/chatter'], fetch_to=LaunchConfiguration('fetch_to'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='recorder',
                              description='what the machine is called'),
        DeclareLaunchArgument('network', default_value='',
                              description="its container network; '' for the engine's own"),
        DeclareLaunchArgument('fetch_to', default_value='~/fogros2',
                              description='folder on the robot for a folder of the recording'),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen'),
    ])
