# SPDX-License-Identifier: Apache-2.0
"""C++ of ROS 2 on a machine: programs, components, image transports, a package built there."""

from __future__ import annotations

import json
import os
from pathlib import Path
import re
import shutil
import sys
import uuid

import pytest

from fogros2 import process
from fogros2.host import workspace
from fogros2.host.inspection import HostFacts
from rigs.launched import launching, VPN_TRAFFIC

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
        assert launched.ended() == 0, launched.text
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

VIEWER = VPN_TRAFFIC + """
import json

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
    print('viewer says', json.dumps({'seen': seen, 'traffic': vpn_traffic()}), flush=True)
"""


@pytest.mark.parametrize(('there', 'back', 'options'), [
    ('republished_compressed', 'theora', {'jpeg_quality': 60}),
    ('ffmpeg', 'ffmpeg', {})])
def test_images_cross_by_image_transport(
    tmp_path: Path, cloud_network: str, there: str, back: str, options: dict[str, int],
) -> None:
    needs('image_transport', *(f'{name.removeprefix("republished_")}_image_transport'
                               for name in (there, back)))
    viewer = tmp_path / 'viewer.py'
    viewer.write_text(VIEWER)
    path = tmp_path / 'stream.launch.py'
    path.write_text(STREAMS.format(
        name=NAME, network=cloud_network, python=sys.executable, viewer=viewer, there=there,
        back=back, options=options))
    with launching() as launch:
        launched = launch(str(path))
        assert launched.ended() == 0, launched.text
    said = re.search(r'viewer says (.*)', launched.text)
    assert said, launched.text
    found = json.loads(said[1])
    assert all(one[1:] == [480, 640, 640 * 480 * 3] for one in found['seen']), found
    # ffmpeg_image_transport tries decoders for graphics cards first
    assert not [line for line in launched.errors
                if 'coder]: ' not in line and '[FFMPEGSubscriber]: ' not in line], launched.text
    # one raw image a direction would be 1.8 MB
    assert 0 < found['traffic'] < len(found['seen']) * 400_000, found


MANIFEST = """<?xml version="1.0"?>
<package format="3">
  <name>{name}</name><version>1.0.0</version><description>A node of a test's own.</description>
  <maintainer email="somebody@example.com">Somebody</maintainer><license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <depend>rclcpp</depend><depend>std_msgs</depend>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""

RECIPE = """cmake_minimum_required(VERSION 3.16)
project({name} CXX)
find_package(ament_cmake REQUIRED)
find_package(rclcpp REQUIRED)
find_package(std_msgs REQUIRED)
add_executable(counter counter.cpp)
ament_target_dependencies(counter rclcpp std_msgs)
install(TARGETS counter DESTINATION lib/${{PROJECT_NAME}})
ament_package()
"""

COUNTER = """
#include <unistd.h>
#include <chrono>
#include <string>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/string.hpp>

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  auto node = std::make_shared<rclcpp::Node>("counter");
  auto publisher = node->create_publisher<std_msgs::msg::String>("chatter", 10);
  int count = 0;
  auto timer = node->create_wall_timer(std::chrono::milliseconds(200), [&]() {
    char host[64];
    gethostname(host, sizeof host);
    std_msgs::msg::String message;
    message.data = std::string("counted on ") + host + ": " + std::to_string(count++);
    publisher->publish(message);
  });
  rclcpp::spin(node);
  rclcpp::shutdown();
}
"""

WORKSPACE = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}', ros_workspace='{root}')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='{package}', executable='counter'),
        Node(package='demo_nodes_cpp', executable='listener', output='screen'),
    ])
"""


def test_a_compiled_package_is_built_as_on_a_machine_and_travels(
        tmp_path: Path, cloud_network: str) -> None:
    needs('rclcpp', 'ament_cmake', 'demo_nodes_cpp')
    if shutil.which('colcon') is None or shutil.which('c++') is None:
        pytest.skip('needs colcon and a C++ compiler')
    package = f'counted_{uuid.uuid4().hex[:6]}'
    root = tmp_path / 'workspace'
    source = root / 'src' / package
    source.mkdir(parents=True)
    (source / 'package.xml').write_text(MANIFEST.format(name=package))
    (source / 'CMakeLists.txt').write_text(RECIPE.format(name=package))
    (source / 'counter.cpp').write_text(COUNTER)
    here = HostFacts(architecture='x86_64')
    way = workspace.plan(workspace.inspect(root), here, here, ros_setup=(), can_build=True,
                         name=NAME)
    assert way.reason == 'it is not built'
    process.run(way.commands[-1], timeout=120.0)
    assert list(workspace.inspect(root).compiled) == [os.uname().machine]
    variables = dict(os.environ)
    for name, below in (('AMENT_PREFIX_PATH', package), ('COLCON_PREFIX_PATH', '')):
        variables[name] = os.pathsep.join(
            filter(None, (str(root / 'install' / below), os.environ.get(name))))
    path = tmp_path / 'workspace.launch.py'
    path.write_text(WORKSPACE.format(
        name=NAME, network=cloud_network, root=root, package=package))
    with launching() as launch:
        launched = launch(str(path), environment=variables)
        launched.wait_for('I heard: [counted on ', times=3)
        launched.interrupt()
        assert launched.ended() == 0, launched.text
    assert f'counted on {os.uname().nodename}:' not in launched.text
    assert not launched.errors, launched.text
