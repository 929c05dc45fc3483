# SPDX-License-Identifier: Apache-2.0
"""A talker in a pod of the kubeconfig's cluster; a listener here."""

from launch.actions import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fogros2 import CloudNode, FogROSLaunchDescription, KubeInstance
from fogros2_examples.choice import argument


def generate_launch_description():
    """Describe the nodes; ``count:=20`` ends the launch after 20 messages."""
    pod = KubeInstance(
        name=LaunchConfiguration('name'), on_exit=LaunchConfiguration('on_exit'),
        container_image=LaunchConfiguration('image'), user=LaunchConfiguration('user'),
        namespace=LaunchConfiguration('namespace'), context=LaunchConfiguration('context'),
        expose=LaunchConfiguration('expose'), mcpu=LaunchConfiguration('mcpu'),
        mb=LaunchConfiguration('mb'))
    return FogROSLaunchDescription([
        argument('name', 'talker-pod', 'what the machine is called'),
        argument('on_exit', 'delete', 'what becomes of it: delete or keep'),
        argument('image', 'docker.io/library/ros:jazzy-ros-base', 'image of the pod'),
        argument('user', 'fog', 'login user there'),
        argument('namespace', '', "namespace; '' for the context's own"),
        argument('context', '', "context of the kubeconfig; '' for the current one"),
        argument('expose', 'auto', 'how the VPN gets to the pod: auto, load_balancer, '
                                   'node_port, pod_dials_robot or pod_ip'),
        argument('mcpu', '0', 'thousandths of a CPU that it may use, 0 for no say'),
        argument('mb', '0', 'MiB of memory that it may use, 0 for no say'),
        argument('count', '0', 'messages after which the launch ends, 0 for never'),
        CloudNode(machine=pod, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             parameters=[{'count': LaunchConfiguration('count')}], on_exit=Shutdown()),
    ])
