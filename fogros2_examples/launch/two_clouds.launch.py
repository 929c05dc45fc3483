# SPDX-License-Identifier: Apache-2.0
"""Two machines at once: a talker on one, a listener on the other, a second listener here."""

from launch_ros.actions import Node

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    """Describe three hosts that talk to each other through the VPN."""
    speaker = ContainerInstance(name='speaker')
    hearer = ContainerInstance(name='hearer')
    return FogROSLaunchDescription([
        CloudNode(machine=speaker, package='fogros2_examples', executable='talker',
                  output='screen'),
        CloudNode(machine=hearer, package='fogros2_examples', executable='listener',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', name='robot_listener',
             output='screen'),
    ])
