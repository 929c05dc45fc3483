# SPDX-License-Identifier: Apache-2.0
"""C++ nodes of ROS 2 on a machine: programs, components, image transports, a package built there."""

from __future__ import annotations

import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import textwrap
import uuid

import pytest

from fogros2 import process
from fogros2.testing.launched import launching

pytestmark = [
    pytest.mark.usefixtures('nothing_left', 'engine'),
    pytest.mark.skipif(process.which('sshd') is None, reason='needs sshd (openssh-server)'),
]

#: Other runs of this test may be under way on the same computer.
NAME = f'cpp-{uuid.uuid4().hex[:6]}'


def needs(*packages: str) -> None:
    """Skip the test where ROS 2 has not these packages."""
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    for package in packages:
        if not any(Path(prefix, 'share', package, 'package.xml').exists()
                   for prefix in prefixes if prefix):
            pytest.skip(f"this computer's ROS 2 has no {package}")


#: A talker and a component on the machine, and a component loaded into the same container later.
LAUNCH = """
from fogros2 import CloudGroup, CloudNode, ContainerInstance, FogROSLaunchDescription
from launch_ros.actions import ComposableNodeContainer, LoadComposableNodes, Node
from launch_ros.descriptions import ComposableNode


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}', ros_workspace='')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='demo_nodes_cpp', executable='talker',
                  remappings=[('chatter', '/words')], output='screen'),
        CloudGroup(machine=machine, actions=[
            ComposableNodeContainer(
                name='box', namespace='/far', package='rclcpp_components',
                executable='component_container', output='screen',
                composable_node_descriptions=[ComposableNode(
                    package='composition', plugin='composition::Talker', name='inside',
                    remappings=[('chatter', '/more')],
                    extra_arguments=[{{'use_intra_process_comms': True}}])]),
            LoadComposableNodes(
                target_container='/far/box',
                composable_node_descriptions=[ComposableNode(
                    package='composition', plugin='composition::Listener', name='beside',
                    remappings=[('chatter', '/more')])]),
        ]),
        Node(package='demo_nodes_cpp', executable='listener', name='hears_words',
             remappings=[('chatter', '/words')], output='screen'),
        Node(package='demo_nodes_cpp', executable='listener', name='hears_more',
             remappings=[('chatter', '/more')], output='screen'),
    ])
"""


def test_programs_and_components_run_on_a_machine(tmp_path: Path, cloud_network: str) -> None:
    needs('demo_nodes_cpp', 'composition', 'rclcpp_components')
    path = tmp_path / 'cpp.launch.py'
    path.write_text(LAUNCH.format(name=NAME, network=cloud_network))
    with launching() as launch:
        launched = launch(str(path))
        launched.wait_for('[hears_words]: I heard:', times=3)
        launched.wait_for('[hears_more]: I heard:', times=3)
        # both components are in the machine's container
        launched.wait_for('[beside]: I heard:', times=3)
        launched.interrupt()
        assert launched.ended(30.0) == 0, launched.text
    assert not launched.errors, launched.text


STREAMS = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription, StreamTopic
from launch.actions import ExecuteProcess, Shutdown
from launch_ros.actions import Node


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}', ros_workspace='')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='image_processor',
                  remappings=[('camera', '/front/camera'), ('annotated', '/seen')],
                  stream_topics=[
                      StreamTopic('/front/camera', '{there}', **{options}),
                      StreamTopic('/seen', '{back}', 'to_robot')]),
        Node(package='fogros2_examples', executable='camera', namespace='front'),
        ExecuteProcess(cmd=['{python}', '{viewer}'], output='screen', on_exit=Shutdown()),
    ])
"""

VIEWER = """
import json
import os
import re

import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

seen = []


def look(image):
    seen.append([image.encoding, image.height, image.width, len(image.data)])
    if len(seen) == 30:
        raise SystemExit


rclpy.init()
node = rclpy.create_node('viewer')
node.create_subscription(Image, '/seen', look, qos_profile_sensor_data)
try:
    rclpy.spin(node)
finally:
    traffic = 0
    with open(os.environ['CYCLONEDDS_URI'].rpartition('file://')[2]) as file:
        interface = re.search('fog[0-9a-f]{6}', file.read())[0]
    for way in ('rx', 'tx'):
        with open(f'/sys/class/net/{interface}/statistics/{way}_bytes') as file:
            traffic += int(file.read())
    print('viewer says', json.dumps({'seen': seen, 'traffic': traffic}), flush=True)
"""


@pytest.mark.parametrize(('there', 'back', 'options'), [
    ('republished_compressed', 'theora', {'jpeg_quality': 60}),
    ('theora', 'republished_compressed', {'out.theora.quality': 20})])
def test_images_cross_by_image_transport(
    tmp_path: Path, cloud_network: str, there: str, back: str, options: dict[str, int],
) -> None:
    needs('image_transport', 'compressed_image_transport', 'theora_image_transport')
    viewer = tmp_path / 'viewer.py'
    viewer.write_text(VIEWER)
    path = tmp_path / 'stream.launch.py'
    path.write_text(STREAMS.format(
        name=NAME, network=cloud_network, python=sys.executable, viewer=viewer, there=there,
        back=back, options=options))
    with launching() as launch:
        launched = launch(str(path))
        assert launched.ended(60.0) == 0, launched.text
    said = re.search(r'viewer says (.*)', launched.text)
    assert said, launched.text
    found = json.loads(said[1])
    assert all(one[1:] == [480, 640, 640 * 480 * 3] for one in found['seen']), found
    assert not launched.errors, launched.text
    # one raw image a direction would be 1.8 MB
    assert 0 < found['traffic'] < len(found['seen']) * 400_000, found
