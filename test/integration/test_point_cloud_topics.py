# SPDX-License-Identifier: Apache-2.0
"""Point clouds between a robot and a machine by ``stream_topics``, as a launch file has it."""

from __future__ import annotations

import json
from pathlib import Path
import re
import shutil
import sys
import uuid

import pytest

pytest.importorskip('zstandard', reason='the extra "point-clouds" is not installed')
from fogros2 import process
from point_cloud_stream.control import COARSEST
from rigs.launched import launching, VPN_TRAFFIC

pytestmark = [
    pytest.mark.usefixtures('nothing_left', 'engine'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
    pytest.mark.skipif(process.which('sshd') is None, reason='needs sshd (openssh-server)'),
]

LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription, StreamTopic
from launch.actions import ExecuteProcess, Shutdown
from launch_ros.actions import Node


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}', ros_workspace='')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='obstacle_finder',
                  stream_topics=[
                      StreamTopic('/points', 'pointcloud', resolution=0.01,
                                  drop_fields='intensity'),
                      StreamTopic('/obstacles', 'pointcloud', 'to_robot', lossless=True)]),
        Node(package='fogros2_examples', executable='lidar'),
        ExecuteProcess(cmd=['{python}', '{viewer}'], output='screen', on_exit=Shutdown()),
    ])
"""

#: Sees both topics under their own names, and counts what crosses the VPN.
VIEWER = VPN_TRAFFIC + """
import json

import numpy
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2

scans, obstacles = {}, {}


def key(cloud):
    return cloud.header.stamp.sec, cloud.header.stamp.nanosec


def points(cloud):
    offsets = {field.name: field.offset for field in cloud.fields}
    values = numpy.frombuffer(cloud.data, numpy.dtype({
        'names': list('xyz'), 'formats': 3 * ['<f4'],
        'offsets': [offsets[name] for name in 'xyz'], 'itemsize': cloud.point_step}))
    return numpy.stack([values[name] for name in 'xyz'], -1).astype(float)


def back(cloud):
    obstacles[key(cloud)] = cloud
    if len(obstacles) == 30:
        raise SystemExit


rclpy.init()
node = rclpy.create_node('viewer')
node.create_subscription(PointCloud2, '/points', lambda cloud: scans.__setitem__(
    key(cloud), cloud), qos_profile_sensor_data)
node.create_subscription(PointCloud2, '/obstacles', back, qos_profile_sensor_data)
try:
    rclpy.spin(node)
finally:
    both = [one for one in obstacles if one in scans]
    errors = []
    for one in both[::3]:
        near = points(scans[one])
        near = near[numpy.isfinite(near[:, 0])]
        errors.append(max(numpy.abs(near - obstacle).max(1).min()
                          for obstacle in points(obstacles[one])[::50]))
    print('viewer says', json.dumps({
        'obstacles': len(obstacles), 'both': len(both), 'traffic': vpn_traffic(),
        'near': min(errors), 'far': max(errors),
        'fields': [field.name for field in obstacles[both[0]].fields],
        'points': min(cloud.width for cloud in obstacles.values())}), flush=True)
"""


def test_clouds_cross_in_both_directions(tmp_path: Path, cloud_network: str) -> None:
    viewer = tmp_path / 'viewer.py'
    viewer.write_text(VIEWER)
    path = tmp_path / 'points.launch.py'
    path.write_text(LAUNCH.format(
        name=f'points-{uuid.uuid4().hex[:6]}', network=cloud_network, python=sys.executable,
        viewer=viewer))
    with launching() as launch:
        launched = launch(str(path))
        assert launched.ended() == 0, launched.text
    said = re.search(r'viewer says (.*)', launched.text)
    assert said, launched.text
    found = json.loads(said[1])
    assert found['both'] >= 5 and found['points'] > 0, found
    # the resolution of the first stream, and the coarsest one, of a busy computer; the second
    # stream is lossless
    assert found['near'] <= 0.005 and found['far'] <= COARSEST / 2, found
    assert found['fields'] == ['x', 'y', 'z', 'ring', 'time']
    # one raw scan would be 360 kB
    assert 0 < found['traffic'] < found['obstacles'] * 120_000, found
