# SPDX-License-Identifier: Apache-2.0
"""A policy: the server on ``machine:=``, its client and an arm with two cameras on the robot."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from fogros2 import CloudNode, FogMachine, FogROSLaunchDescription
from fogros2_examples.ending import ended
from fogros2_examples.files import checked, PICTURES


def generate_launch_description():
    """Describe the nodes; ``policy:=`` is an ONNX file here, ``picture:=`` a file to write."""
    shown = {'targets': (6, 'how many targets the arm reaches for'),
             'runs': ('', 'a file to which the course is added, as a line of JSON'),
             'picture': ('', 'a file to draw the runs in')}

    def given(name, kind):
        return {name: ParameterValue(LaunchConfiguration(name), value_type=kind)}

    return FogROSLaunchDescription([
        DeclareLaunchArgument('machine', default_value='container',
                              choices=['robot', 'container', 'aws', 'kubernetes'],
                              description='where the policy runs'),
        DeclareLaunchArgument('transport', default_value='h264',
                              description='of the images there: h264, compressed or raw'),
        DeclareLaunchArgument('foxglove', default_value='false',
                              description='show the topics in a browser: ros2 fog monitor'),
        DeclareLaunchArgument('policy', description='an ONNX file; make demo-policy trains one'),
        DeclareLaunchArgument('slowdown', default_value='1.0',
                              description='how many times slower the policy runs'),
        *(DeclareLaunchArgument(name, default_value=str(value), description=what)
          for name, (value, what) in shown.items()),
        checked({'policy': 'make demo-policy trains one'}, {'runs': (), 'picture': PICTURES},
                readers={'policy': 'fogros2_examples.policy.onnx_file:check'}),
        FogMachine(LaunchConfiguration('machine'), {
            'name': 'policy', 'launch_foxglove': LaunchConfiguration('foxglove')}),
        CloudNode(machine='policy', package='fogros2_examples', executable='policy_server',
                  output='screen', on_exit=ended, parameters=[given('slowdown', float)],
                  stream_topics=[(f'/arm/{camera}/image', LaunchConfiguration('transport'))
                                 for camera in ('top', 'side')]),
        Node(package='fogros2_examples', executable='policy_client', output='screen',
             on_exit=ended, parameters=[given('policy', str)]),
        Node(package='fogros2_examples', executable='policy_arm', output='screen', on_exit=ended,
             parameters=[{'label': LaunchConfiguration('machine')}, *(
                 given(name, type(value)) for name, (value, _) in shown.items())]),
    ])
