# SPDX-License-Identifier: Apache-2.0
"""Images and point clouds between robot and machines by ``stream_topics``, in launch files."""

from __future__ import annotations

import json
from pathlib import Path
import re
import shutil
import sys
import time
import uuid

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.waiting import wait_until
from rigs.launched import Launched, launching, ros2, VPN_TRAFFIC

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('zstandard', reason='the extra "point-clouds" is not installed')
from point_cloud_stream.control import COARSEST

pytestmark = [
    pytest.mark.usefixtures('nothing_left', 'engine'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
    pytest.mark.skipif(process.which('sshd') is None, reason='needs sshd (openssh-server)'),
]

#: Other runs of this test may be under way on the same computer.
NAME = f'stream-{uuid.uuid4().hex[:6]}'

#: The user calls the topic otherwise at the node, in a group, and relative to a namespace.
LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription, StreamTopic
from launch.actions import ExecuteProcess, GroupAction, Shutdown
from launch_ros.actions import Node, PushRosNamespace, SetRemap


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}', ros_workspace='')
    return FogROSLaunchDescription([
        GroupAction([
            PushRosNamespace('front'),
            SetRemap('annotated', '/seen'),
            CloudNode(machine=machine, package='fogros2_examples', executable='image_processor',
                      namespace='processing', remappings=[('camera', '/front/camera')],
                      stream_topics=[('/front/camera', 'h264'),
                                     StreamTopic('/seen', 'h264', 'to_robot')]),
        ]),
        Node(package='fogros2_examples', executable='camera', namespace='front',
             parameters=[{{'width': 320, 'height': 240}}]),
        CloudNode(machine=machine, package='fogros2_examples', executable='obstacle_finder',
                  stream_topics=[
                      StreamTopic('/points', 'pointcloud', resolution=0.01,
                                  drop_fields='intensity'),
                      StreamTopic('/obstacles', 'pointcloud', 'to_robot', lossless=True)]),
        Node(package='fogros2_examples', executable='lidar'),
        ExecuteProcess(cmd=['{python}', '{viewer}'], output='screen', on_exit=Shutdown()),
    ])
"""

#: Sees the topics under their own names, as a viewer that knows nothing of streams does.
VIEWER = VPN_TRAFFIC + """
import json
import sys

import numpy
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, PointCloud2

taken, seen, scans, obstacles = {}, {}, {}, {}


def stamp(message):
    return message.header.stamp.sec, message.header.stamp.nanosec


def look(image, images=taken):
    images[stamp(image)] = (image.header.frame_id, image.encoding, image.height, image.width,
                            image.step, len(image.data))
    if len(seen) >= 60 and len(obstacles) >= 30:
        raise SystemExit


def points(cloud):
    offsets = {field.name: field.offset for field in cloud.fields}
    values = numpy.frombuffer(cloud.data, numpy.dtype({
        'names': list('xyz'), 'formats': 3 * ['<f4'],
        'offsets': [offsets[name] for name in 'xyz'], 'itemsize': cloud.point_step}))
    return numpy.stack([values[name] for name in 'xyz'], -1).astype(float)


def obstacle_figures():
    # how far the obstacles of some scans are from the scans' points
    both = [one for one in obstacles if one in scans]
    errors = []
    for one in both[::3]:
        near = points(scans[one])
        near = near[numpy.isfinite(near[:, 0])]
        errors.append(max(numpy.abs(near - obstacle).max(1).min()
                          for obstacle in points(obstacles[one])[::50]))
    return {'both': len(both), 'near': min(errors), 'far': max(errors),
            'fields': [field.name for field in obstacles[both[0]].fields],
            'points': min(cloud.width for cloud in obstacles.values())}


rclpy.init()
node = rclpy.create_node('viewer')
for kind, topic, hear in (
        (Image, '/front/camera', look), (Image, '/seen', lambda image: look(image, seen)),
        (PointCloud2, '/points', lambda cloud: scans.update({stamp(cloud): cloud})),
        (PointCloud2, '/obstacles', lambda cloud: obstacles.update({stamp(cloud): cloud}))):
    node.create_subscription(kind, topic, hear, qos_profile_sensor_data)
try:
    rclpy.spin(node)
finally:
    both = [one for one in seen if one in taken]
    print('viewer says', json.dumps({
        'seen': len(seen), 'both': len(both), 'traffic': vpn_traffic(),
        'same': all(seen[one] == taken[one] for one in both),
        'kinds': sorted(set(seen.values())), 'obstacles': len(obstacles),
        'clouds': obstacle_figures()}), flush=True)
"""


def no_node_failed(run: Launched) -> bool:
    """Return whether all nodes ended in order; rclpy of ROS 2 may fail at Ctrl-C."""
    # an interrupt while rclpy converts a large message ends any Python node so
    return not run.errors or 'Unable to convert call argument' in run.text


#: The machine in the middle can be taken away.
GOING = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription, StreamTopic
from launch_ros.actions import Node


def generate_launch_description():
    first = ContainerInstance(name='{name}-a', network='{network}', ros_workspace='',
                              on_interrupt='robot')
    second = ContainerInstance(name='{name}-b', network='{network}', ros_workspace='')
    return FogROSLaunchDescription([
        CloudNode(machine=second, package='fogros2_examples', executable='image_processor',
                  name='last', remappings=[('camera', '/between')], output='screen',
                  stream_topics=[StreamTopic('/between', 'h264', source=first)]),
        CloudNode(machine=first, package='fogros2_examples', executable='image_processor',
                  name='middle', remappings=[('camera', '/front/camera'),
                                             ('annotated', '/between')],
                  output='screen', stream_topics=[('/front/camera', 'h264')]),
        Node(package='fogros2_examples', executable='camera', namespace='front',
             parameters=[{{'width': 320, 'height': 240, 'rate': 15.0}}]),
    ])
"""


def test_streams_go_on_when_the_machine_between_goes(
    tmp_path: Path, cloud_network: str, engine: str,
) -> None:
    path = tmp_path / 'going.launch.py'
    path.write_text(GOING.format(name=NAME, network=cloud_network))
    with launching() as launch:
        run = launch(str(path))
        run.wait_for('[last]:')
        wait_until(
            lambda: any(float(rate) > 1 for rate in re.findall(
                rf'^/between \(h264\) +\S+ +{NAME}-b +([0-9.]+) ',
                ros2('fog', 'status', f'{NAME}-b').stdout, re.MULTILINE)),
            timeout=60.0, what='a rate of the stream')
        process.run(Command((engine, 'rm', '-f', '-t', '0', f'fogros2-{NAME}-a'), sudo=True),
                    timeout=60.0)
        run.wait_for(f"the machine '{NAME}-a' is gone")
        # the one here takes the camera's images as they are, and gives the other machine its own
        wait_until(lambda: re.search(r'^\[image_processor-\d+\].* images/s', run.text, re.M),
                   timeout=60.0, what='images of the camera')
        since = time.monotonic()
        wait_until(lambda: len(run.since(since, '[last]: ')) >= 2, timeout=60.0,
                   what='images of the one here on the other machine')
        run.interrupt()
        assert run.ended() == 0, run.text
        assert no_node_failed(run), run.text


def test_streams_cross_encoded(tmp_path: Path, cloud_network: str) -> None:
    viewer = tmp_path / 'viewer.py'
    viewer.write_text(VIEWER)
    path = tmp_path / 'stream.launch.py'
    path.write_text(LAUNCH.format(
        name=NAME, network=cloud_network, python=sys.executable, viewer=viewer))
    with launching() as launch:
        launched = launch(str(path))
        assert launched.ended() == 0, launched.text
    said = re.search(r'viewer says (.*)', launched.text)
    assert said, launched.text
    found = json.loads(said[1])
    assert found['kinds'] == [['camera', 'bgr8', 240, 320, 960, 320 * 240 * 3]]
    # of some the viewer here lost the raw one, as its QoS allows
    assert found['same'] and found['both'] >= 10, found
    assert no_node_failed(launched), launched.text
    # one raw image a direction would be 460 kB, one raw scan 360 kB
    assert 0 < found['traffic'] < found['seen'] * 100_000 + found['obstacles'] * 120_000, found
    clouds = found['clouds']
    assert clouds['both'] >= 5 and clouds['points'] > 0, clouds
    # the resolution of the first stream, and the coarsest one, of a busy computer; the second
    # stream is lossless
    assert clouds['near'] <= 0.005 and clouds['far'] <= COARSEST / 2, clouds
    assert clouds['fields'] == ['x', 'y', 'z', 'ring', 'time']
