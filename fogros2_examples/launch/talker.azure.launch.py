# SPDX-License-Identifier: Apache-2.0
"""A talker on a new machine at Azure; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import AzureCloudInstance, CloudNode, FogROSLaunchDescription


def generate_launch_description():
    """Describe the nodes; ``region:=westeurope spot:=true`` choose the kind of machine."""
    machine = AzureCloudInstance(
        name=LaunchConfiguration('name'), region=LaunchConfiguration('region'),
        vm_size=LaunchConfiguration('vm_size'), spot=LaunchConfiguration('spot'),
        on_exit=LaunchConfiguration('on_exit'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='talker-azure',
                              description='what the machine is called'),
        DeclareLaunchArgument('region', default_value='',
                              description="region of Azure, or 'nearest'; else that of "
                              'AZURE_DEFAULTS_LOCATION, or eastus'),
        DeclareLaunchArgument('vm_size', default_value='Standard_B2als_v2',
                              description="size of the machine, or 'cheapest'"),
        DeclareLaunchArgument('spot', default_value='false',
                              description='cheaper, and Azure may take it back'),
        DeclareLaunchArgument('on_exit', default_value='delete',
                              description='what becomes of it: delete, stop or keep'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
