# SPDX-License-Identifier: Apache-2.0
"""A talker on a new Compute Engine instance; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, FogROSLaunchDescription, GCPCloudInstance


def generate_launch_description():
    """Describe the nodes; ``region:=europe-west3 spot:=true`` choose the kind of instance."""
    machine = GCPCloudInstance(
        name=LaunchConfiguration('name'), project_id=LaunchConfiguration('project_id'),
        region=LaunchConfiguration('region'), machine_type=LaunchConfiguration('machine_type'),
        spot=LaunchConfiguration('spot'), on_exit=LaunchConfiguration('on_exit'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='talker-gcp',
                              description='what the machine is called'),
        DeclareLaunchArgument('project_id', default_value='',
                              description="project; else that of the user's credentials"),
        DeclareLaunchArgument('region', default_value='',
                              description="region, or 'nearest'; else us-central1"),
        DeclareLaunchArgument('machine_type', default_value='e2-medium',
                              description='type of the instance'),
        DeclareLaunchArgument('spot', default_value='false',
                              description='cheaper, and Google may take it back'),
        DeclareLaunchArgument('on_exit', default_value='delete',
                              description='what becomes of it: delete, stop or keep'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
