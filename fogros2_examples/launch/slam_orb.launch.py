# SPDX-License-Identifier: Apache-2.0
"""ORB-SLAM2 or 3 from your own container image, instead of the example's own SLAM."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from fogros2 import CloudNode, FogMachine, FogROSLaunchDescription
from fogros2_examples.ending import ended
from fogros2_examples.files import checked, PICTURES


def generate_launch_description():
    """Describe the nodes; default names are those of the usual ROS 2 wrapper of ORB-SLAM3."""
    asked = {'image': (None, 'with ROS 2 and ORB-SLAM, such as me/orb-slam3:jazzy'),
             'package': ('orbslam3', 'in the image'), 'executable': ('stereo', 'of that package'),
             'vocabulary': ('/ORB_SLAM3/Vocabulary/ORBvoc.txt', 'in the image'),
             'settings': ('/ORB_SLAM3/fogros2_room.yaml', "the camera's, in the image"),
             'left': ('camera/left', 'its topic for the image, or the left one'),
             'right': ('camera/right', 'its topic for the right image'),
             'depth': ('camera/depth', 'its topic for the depth image'),
             'pose': ('camera/pose', 'its topic for poses (geometry_msgs/PoseStamped)'),
             'options': ('', "of 'docker run' for it, such as '--gpus=all, -v, /orb:/orb:ro'"),
             'mounts': ('', 'folders that a container machine sees, such as that of the image')}
    shown = {'dataset': ('', "a folder in TUM's RGB-D format, '' for the synthetic room"),
             'stereo': (True, 'whether the synthetic camera has two eyes, or sees depth'),
             'grey': (False, "whether its images are grey, as most stereo cameras' are"),
             'width': (640, 'of its images'), 'height': (480, 'of its images'),
             'frames': (200, 'after which the launch ends; 0 for all that a dataset has'),
             'rate': (10.0, 'frames per second, at most'),
             'wait': (True, 'whether a frame waits for the pose of the one before'),
             'picture': ('', 'a file to draw the trajectory in'),
             'results': ('', 'a file for the figures, as JSON')}
    names = [(LaunchConfiguration('left'), '/camera/image'),
             (LaunchConfiguration('right'), '/camera/right/image'),
             (LaunchConfiguration('depth'), '/camera/depth'),
             (LaunchConfiguration('pose'), '/pose')]
    # JPEG would damage depth images.
    deep = PythonExpression(
        ["'raw' if '", LaunchConfiguration('transport'), "' == 'raw' else 'h264'"])
    return FogROSLaunchDescription([
        DeclareLaunchArgument('machine', default_value='container',
                              choices=['container', 'aws', 'kubernetes'],
                              description='where SLAM runs'),
        DeclareLaunchArgument('transport', default_value='h264',
                              description='of the images there: h264, compressed or raw'),
        *(DeclareLaunchArgument(
            name, default_value=None if value is None else str(value), description=what)
          for name, (value, what) in (asked | shown).items()),
        # Other machines than containers can run containers by default.
        checked({'dataset': "'' stands for the synthetic room"},
                {'picture': PICTURES, 'results': ()}, folders=['dataset'],
                readers={'dataset': 'fogros2_examples.slam.tum:read'}),
        FogMachine(LaunchConfiguration('machine'), {
            'name': 'slam', 'mounts': LaunchConfiguration('mounts'),
            'containers': PythonExpression(
                ["'true' if '", LaunchConfiguration('machine'), "' == 'container' else ''"])}),
        CloudNode(machine='slam', image=LaunchConfiguration('image'), output='screen',
                  on_exit=ended,
                  image_options=LaunchConfiguration('options'),
                  package=LaunchConfiguration('package'),
                  executable=LaunchConfiguration('executable'), remappings=names,
                  arguments=[LaunchConfiguration('vocabulary'), LaunchConfiguration('settings'),
                             'false'],
                  stream_topics=[(f'/camera/{name}', LaunchConfiguration('transport')) for name in
                                 ('image', 'right/image')] + [('/camera/depth', deep)]),
        Node(package='fogros2_examples', executable='slam_camera', output='screen',
             parameters=[{name: ParameterValue(LaunchConfiguration(name), value_type=type(value))
                          for name, (value, _) in shown.items()}], on_exit=ended),
    ])
