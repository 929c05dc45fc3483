# SPDX-License-Identifier: Apache-2.0
"""Visual SLAM: the algorithm on ``machine:=``, the camera on the robot."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from fogros2 import CloudNode, FogMachine, FogROSLaunchDescription
from fogros2_examples.ending import ended
from fogros2_examples.files import checked, PICTURES


def generate_launch_description():
    """Describe the nodes; the default is a stereo camera in a synthetic room."""
    shown = {'dataset': ('', "a folder in TUM's RGB-D format, '' for the synthetic room"),
             'stereo': (True, 'whether the synthetic camera has two eyes, or sees depth'),
             'grey': (False, "whether its images are grey, as most stereo cameras' are"),
             'width': (640, 'of its images'), 'height': (480, 'of its images'),
             'frames': (200, 'after which the launch ends; 0 for all that a dataset has'),
             'rate': (10.0, 'frames per second, at most'),
             'wait': (True, 'whether a frame waits for the pose of the one before'),
             'picture': ('', 'a file to draw the trajectory in'),
             'results': ('', 'a file for the figures, as JSON')}
    answer = LaunchConfiguration('on_interrupt')
    folder = PythonExpression(["'$HOME/.ros/slam' if '", answer, "' == 'replace' else ''"])
    return FogROSLaunchDescription([
        DeclareLaunchArgument('machine', default_value='container',
                              choices=['robot', 'container', 'aws', 'kubernetes'],
                              description='where SLAM runs'),
        DeclareLaunchArgument('transport', default_value='h264',
                              description='of the images there: h264, compressed or raw'),
        DeclareLaunchArgument('foxglove', default_value='false',
                              description='show the topics in a browser: ros2 fog monitor'),
        DeclareLaunchArgument('on_interrupt', default_value='shutdown',
                              description="'replace': keep the map, and continue it elsewhere"),
        *(DeclareLaunchArgument(name, default_value=str(value), description=what)
          for name, (value, what) in shown.items()),
        checked({'dataset': "'' stands for the synthetic room"},
                {'picture': PICTURES, 'results': ()}, folders=['dataset'],
                readers={'dataset': 'fogros2_examples.slam.tum:read'}),
        FogMachine(LaunchConfiguration('machine'), {'name': 'slam', 'on_interrupt': answer,
                   'launch_foxglove': LaunchConfiguration('foxglove')}),
        CloudNode(machine='slam', package='fogros2_examples', executable='slam', output='screen',
                  on_exit=ended, checkpoint=folder,
                  parameters=[{'map_folder': ParameterValue(folder, value_type=str)}],
                  stream_topics=[(f'/camera/{name}', LaunchConfiguration('transport')) for name in
                                 ('image', 'right/image')] + [('/camera/depth', 'h264')]),
        Node(package='fogros2_examples', executable='slam_camera', output='screen',
             parameters=[{name: ParameterValue(LaunchConfiguration(name), value_type=type(value))
                          for name, (value, _) in shown.items()}], on_exit=ended),
    ])
