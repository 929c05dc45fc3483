# SPDX-License-Identifier: Apache-2.0
"""A talker in a pod of the kubeconfig's cluster; a listener here."""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, FogROSLaunchDescription, KubeInstance


def generate_launch_description():
    """Describe the nodes; ``count:=20`` ends the launch after 20 messages."""
    pod = KubeInstance(
        name=LaunchConfiguration('name'), on_exit=LaunchConfiguration('on_exit'),
        container_image=LaunchConfiguration('image'), user=LaunchConfiguration('user'),
        namespace=LaunchConfiguration('namespace'), context=LaunchConfiguration('context'),
        expose=LaunchConfiguration('expose'), mcpu=LaunchConfiguration('mcpu'),
        mb=LaunchConfiguration('mb'))
    return FogROSLaunchDescription([
        DeclareLaunchArgument('name', default_value='talker-pod',
                              description='what the machine is called'),
        DeclareLaunchArgument('on_exit', default_value='delete',
                              description='what becomes of it: delete or keep'),
        DeclareLaunchArgument('image', default_value='docker.io/library/ros:jazzy-ros-base',
                              description='image of the pod'),
        DeclareLaunchArgument('user', default_value='fog',
                              description='login user there'),
        DeclareLaunchArgument('namespace', default_value='',
                              description="namespace; '' for the context's own"),
        DeclareLaunchArgument('context', default_value='',
                              description="context of the kubeconfig; '' for the current one"),
        DeclareLaunchArgument('expose', default_value='auto',
                              description='how the VPN gets to the pod: auto, load_balancer, '
                              'node_port, pod_dials_robot or pod_ip'),
        DeclareLaunchArgument('mcpu', default_value='0',
                              description='thousandths of a CPU that it may use, 0 for no say'),
        DeclareLaunchArgument('mb', default_value='0',
                              description='MiB of memory that it may use, 0 for no say'),
        DeclareLaunchArgument('count', default_value='0',
                              description='messages after which the launch ends, 0 for never'),
        CloudNode(machine=pod, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
