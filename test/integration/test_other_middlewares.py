# SPDX-License-Identifier: Apache-2.0
"""A launch on a middleware other than Cyclone's: nodes hear each other and know of each other."""

from __future__ import annotations

import contextlib
import importlib.util
import os
from pathlib import Path
import shutil
import socket
import uuid

import pytest

from fogros2 import process
from fogros2.dds.zenoh import USERS_ROUTER
from fogros2.model import Command
from rigs.colcon_workspace import colcon_workspace
from rigs.launched import launching

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


def runs(process_id: str) -> bool:
    """Return whether a process is there; one that has ended and waits to be reaped isn't."""
    path = Path('/proc', process_id, 'cmdline')
    return path.exists() and path.read_bytes() != b''


def test_missing_module_of_the_robot_is_refused_first(
        tmp_path: Path, cloud_network: str) -> None:
    if has_middleware('rmw_fastrtps_cpp'):
        pytest.skip("this computer's ROS 2 has rmw_fastrtps_cpp")
    path = tmp_path / 'rmw.launch.py'
    path.write_text(LAUNCH.format(name=NAME, network=cloud_network, look='true', dds='fastdds'))
    with launching() as launch:
        launched = launch(str(path))
        assert launched.ended() == 1, launched.text
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
        assert launched.ended() == 0, launched.text
    assert not launched.errors, launched.text


#: Stand where rmw_zenoh's programs do: the router, and nodes that are zenoh's own.
ROUTER = """
import os, signal, threading, zenoh
ended = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: ended.set())
signal.signal(signal.SIGINT, lambda *_: ended.set())
with zenoh.open(zenoh.Config.from_file(os.environ['ZENOH_ROUTER_CONFIG_URI'])):
    ended.wait()
"""
TALKER = """
import os, sys, time, zenoh
with zenoh.open(zenoh.Config.from_file(os.environ['ZENOH_SESSION_CONFIG_URI'])) as session:
    for number in range(6000):
        session.put(sys.argv[1], f'{number} from {os.uname().nodename}')
        time.sleep(0.1)
"""
LISTENER = """
import os, sys, time, zenoh
with zenoh.open(zenoh.Config.from_file(os.environ['ZENOH_SESSION_CONFIG_URI'])) as session:
    session.declare_subscriber(sys.argv[1], lambda sample: print(
        'I heard', sys.argv[1], sample.payload.to_string(), flush=True))
    time.sleep(600)
"""
ZENOH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch_ros.actions import Node


def node(where, executable, topic):
    words = dict(package='rmw_zenoh_cpp', executable=executable, arguments=[topic],
                 output='screen')
    return CloudNode(machine=where, **words) if where else Node(**words)


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}', ros_workspace='{root}')
    return FogROSLaunchDescription([
        node(machine, 'talker', 'down'), node(machine, 'listener', 'up'),
        node(None, 'talker', 'up'), node(None, 'listener', 'down'),
    ], dds='zenoh')
"""


def test_zenoh_has_a_router_on_each_side(tmp_path: Path, cloud_network: str) -> None:
    pytest.importorskip('zenoh', reason='eclipse-zenoh is not installed')
    if has_middleware('rmw_zenoh_cpp'):
        pytest.skip("this computer's ROS 2 has rmw_zenoh_cpp, which this stands for")
    if importlib.util.find_spec('rosidl_embedded') is None:
        pytest.skip("this computer's ROS 2 has no rmw_zenoh_cpp, and its rcl loads no stand-in")
    root = tmp_path / 'workspace'
    variables = {**os.environ, **colcon_workspace(root, 'rmw_zenoh_cpp', programs={
        'rmw_zenohd': ROUTER, 'talker': TALKER, 'listener': LISTENER})}
    # zenoh looks for nothing else all the same
    variables.pop('ROS_AUTOMATIC_DISCOVERY_RANGE')
    index = root / 'install/rmw_zenoh_cpp/share/ament_index/resource_index/rmw_typesupport'
    index.mkdir()
    (index / 'rmw_zenoh_cpp').touch()
    path = tmp_path / 'rmw.launch.py'
    path.write_text(ZENOH.format(name=NAME, network=cloud_network, root=root))
    with contextlib.ExitStack() as users, launching() as launch:
        # stands for a router of the user's, where there is none
        with contextlib.suppress(OSError):
            users.enter_context(socket.create_server(USERS_ROUTER))
        launched = launch(str(path), environment=variables)
        launched.wait_for('do not reach the nodes of another rmw_zenohd on this robot')
        launched.wait_for('I heard up', times=3)
        launched.wait_for('I heard down', times=3)
        routers = process.run(
            Command(('pgrep', '-f', f'{root}.*/rmw_zenohd')), timeout=60.0).stdout.split()
        # the robot's program and the shell that ends it with the launch; the machine's
        assert len(routers) >= 3
        launched.interrupt()
        launched.ended()
    assert not [one for one in routers if runs(one)]
