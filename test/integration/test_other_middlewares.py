# SPDX-License-Identifier: Apache-2.0
"""A launch on a middleware other than Cyclone's: nodes hear each other and know of each other."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import uuid

import pytest

from fogros2 import process
from fogros2.testing.launched import launching

pytestmark = [
    pytest.mark.usefixtures('nothing_left', 'engine'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
    pytest.mark.skipif(process.which('sshd') is None, reason='needs sshd (openssh-server)'),
]

NAME = f'rmw-{uuid.uuid4().hex[:6]}'

LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch.actions import ExecuteProcess
from launch_ros.actions import Node


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}', ros_workspace='')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  name='far_talker', remappings=[('chatter', '/down')]),
        CloudNode(machine=machine, package='fogros2_examples', executable='listener',
                  name='far_listener', remappings=[('chatter', '/up')]),
        Node(package='fogros2_examples', executable='talker', name='near_talker',
             remappings=[('chatter', '/up')]),
        Node(package='fogros2_examples', executable='listener', name='near_listener',
             remappings=[('chatter', '/down')]),
        ExecuteProcess(cmd=['sh', '-c', '{look}'], output='screen'),
    ], dds='{dds}')
"""
#: Which nodes a terminal sees, asked again until all are there.
LOOK = ('for i in 1 2 3 4 5 6 7 8; do '
        'found=$(ros2 node list --no-daemon --spin-time 2); '
        'case "$found" in */far_listener*/far_talker*/near_listener*/near_talker*) '
        'echo all four are seen; break;; esac; echo "$found"; done')


def has_middleware(name: str) -> bool:
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    return any(Path(prefix, 'share/ament_index/resource_index/rmw_typesupport', name).exists()
               for prefix in prefixes if prefix)


def test_what_nodes_here_lack_is_refused_before_anything_is_made(
        tmp_path: Path, cloud_network: str) -> None:
    if has_middleware('rmw_fastrtps_cpp'):
        pytest.skip("this computer's ROS 2 has rmw_fastrtps_cpp")
    path = tmp_path / 'rmw.launch.py'
    path.write_text(LAUNCH.format(name=NAME, network=cloud_network, look='true', dds='fastdds'))
    with launching() as launch:
        launched = launch(str(path))
        assert launched.ended(30.0) == 1, launched.text
    assert 'rmw_fastrtps_cpp' in launched.errors[0], launched.text
    assert ': machine' not in launched.text


def test_fast_dds_carries_a_launch(tmp_path: Path, cloud_network: str) -> None:
    if not has_middleware('rmw_fastrtps_cpp'):
        pytest.skip('needs ROS 2 with rmw_fastrtps_cpp')
    path = tmp_path / 'rmw.launch.py'
    path.write_text(LAUNCH.format(name=NAME, network=cloud_network, look=LOOK, dds='fastdds'))
    with launching() as launch:
        launched = launch(str(path))
        launched.wait_for('[near_listener]: I heard:', times=3)
        launched.wait_for('[far_listener]: I heard:', times=3)
        launched.wait_for('all four are seen')
        launched.interrupt()
        assert launched.ended(30.0) == 0, launched.text
    assert not launched.errors, launched.text
