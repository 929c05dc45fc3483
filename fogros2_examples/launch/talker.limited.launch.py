# SPDX-License-Identifier: Apache-2.0
"""Ten greetings a second here; one a second crosses to a container machine, and no diary does."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    """Describe a talker and two listeners for each topic."""
    machine = ContainerInstance(
        name=LaunchConfiguration('name'), deny_topics=['/diary'], limit_topics={'/news': '1 Hz'})
    nodes = [DeclareLaunchArgument('name', default_value='quiet-link',
                                   description='what the machine is called')]
    for topic in ('news', 'diary', 'letters'):
        kind = {'package': 'fogros2_examples', 'output': 'screen',
                'remappings': [('chatter', topic)]}
        nodes += [
            Node(executable='talker', name=f'{topic}_talker', parameters=[{'period': 0.1}],
                 **kind),
            Node(executable='listener', name=f'{topic}_here', **kind),
            CloudNode(machine=machine, executable='listener', name=f'{topic}_there', **kind)]
    return FogROSLaunchDescription(nodes)
