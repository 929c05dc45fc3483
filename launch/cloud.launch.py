# SPDX-License-Identifier: Apache-2.0
"""One node on a machine: package:= and executable:=, on a container of this computer."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration

from fogros2 import ContainerInstance, FogROSLaunchDescription, Node


def generate_launch_description():
    """Describe the node; ``--machine cloud=aws`` runs it on another kind of machine."""
    return FogROSLaunchDescription([
        DeclareLaunchArgument('package', description='package of the node'),
        DeclareLaunchArgument('executable', description='executable of the node'),
        Node(machine=ContainerInstance(name='cloud'), output='screen',
             package=LaunchConfiguration('package'),
             executable=LaunchConfiguration('executable')),
    ])
