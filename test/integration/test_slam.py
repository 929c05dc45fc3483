# SPDX-License-Identifier: Apache-2.0
"""The nodes of the SLAM example: on a container machine, and with what cameras send at times."""

from __future__ import annotations

from importlib.util import find_spec
import json
from pathlib import Path
import shutil
import signal
import subprocess
import sys

import pytest

pytest.importorskip('cv2', reason='OpenCV (the extra "applications") is not installed')
pytest.importorskip('gtsam', reason='GTSAM (the extra "applications") is not installed')
rclpy = pytest.importorskip('rclpy')

from ament_index_python.packages import get_package_prefix  # noqa: E402
from builtin_interfaces.msg import Time  # noqa: E402
import cv2  # noqa: E402
from geometry_msgs.msg import PoseStamped  # noqa: E402
from nav_msgs.msg import Path as PathMessage  # noqa: E402
import numpy  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image, PointCloud2  # noqa: E402
from std_msgs.msg import Header, String  # noqa: E402

from fogros2.waiting import wait_until  # noqa: E402
from fogros2_examples.nodes import LATCHED  # noqa: E402
from fogros2_examples.slam import messages, room  # noqa: E402
from fogros2_examples.slam.camera import SlamCamera  # noqa: E402
from fogros2_examples.slam.node import TFMessage  # noqa: E402

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]
TRANSFORMS = [('/tf', TFMessage, 10)] if TFMessage else []
SMALL = ('width:=320', 'height:=240', 'frames:=25', 'rate:=20.0')


@pytest.mark.skipif(find_spec('evo') is None, reason='evo (the extra "applications") is missing')
def test_slam_launch_file_runs_on_a_machine(launch, engine, tmp_path):
    """Every frame is answered, the way is found, the picture drawn."""
    run = launch('fogros2_examples', 'slam.launch.py', *SMALL,
                 'stereo:=false', 'grey:=true', f'picture:={tmp_path}/way.png',
                 f'results:={tmp_path}/results.json')
    assert run.ended() == 0, run.text
    assert run.errors == [], run.text
    found = json.loads((tmp_path / 'results.json').read_text())
    assert found['sent'] == 25
    assert len(found['round_trips']) >= 20, run.text
    assert all(0 < took < trip for took, trip in zip(found['computing'], found['round_trips']))
    assert found['final_ate'] < 0.1
    assert cv2.imread(str(tmp_path / 'way.png')).shape[1] > 1000


def test_slam_of_an_image_replaces_the_slam_node(launch, images, crun, with_python, tmp_path):
    """Our own stands for it: in an image of this computer's, under names that are its own."""
    run = launch(
        'fogros2_examples', 'slam_orb.launch.py', f'image:=oci-archive:{images}/system.tar',
        f'mounts:={", ".join([str(images), *crun])}', f'options:={", ".join(with_python)}',
        'package:=fogros2_examples', 'executable:=slam', 'left:=camera/image',
        'right:=camera/right/image', 'pose:=pose', *SMALL, f'results:={tmp_path}/results.json')
    assert run.ended() == 0, run.text
    assert run.errors == [], run.text
    found = json.loads((tmp_path / 'results.json').read_text())
    assert found['sent'] == 25
    assert len(found['round_trips']) >= 20, run.text
    if find_spec('evo'):
        assert found['live_ate'] < 0.1


@pytest.mark.skipif(find_spec('evo') is None, reason='evo (the extra "applications") is missing')
def test_picture_works_without_a_path(tmp_path):
    """It is of the poses as they came."""
    picture = tmp_path / 'way.png'
    rclpy.init(args=['--ros-args', '-p', f'picture:={picture}', '-p', 'frames:=1',
                     '-p', 'width:=320', '-p', 'height:=240'])
    node = SlamCamera()
    try:
        for stamp, pose in enumerate(room.trajectory(20)):
            node.sent[stamp], node.answered[stamp] = 0.0, 0.1
            node.truth[stamp] = node.live[stamp] = pose
        assert node.report() == 0
        assert cv2.imread(str(picture)).shape[1] > 1000
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


class Side:
    """A robot's side in this process: publishes what a test says, keeps what comes back."""

    def __init__(self):
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('side', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.publishers = {
            topic: self.node.create_publisher(kind, f'camera/{topic}', 2) for topic, kind in (
                ('image', Image), ('depth', Image), ('camera_info', CameraInfo))}
        self.heard = {}
        for topic, kind, qos in (
                ('pose', PoseStamped, 10), ('slam_state', String, LATCHED), *TRANSFORMS,
                ('path', PathMessage, LATCHED), ('map_points', PointCloud2, LATCHED)):
            self.heard[topic] = []
            self.node.create_subscription(kind, topic, self.heard[topic].append, qos)
        self.stamp = 0

    def show(self, image, depth, encoding='bgr8', info=None):
        """Publish a frame; return its stamp."""
        self.stamp += 1
        header = Header(stamp=Time(sec=self.stamp), frame_id='eye')
        self.publishers['camera_info'].publish(
            info or messages.camera_info(header, room.camera(320, 240), False))
        self.publishers['image'].publish(messages.image(header, image, encoding))
        self.publishers['depth'].publish(messages.image(header, depth, '16UC1'))
        return self.stamp

    def until(self, condition, what, meanwhile=lambda: None):
        def met():
            meanwhile()
            for _ in range(10):
                self.executor.spin_once(timeout_sec=0.02)
            return bool(condition())
        wait_until(met, timeout=60, what=what)

    def said(self, text):
        return any(text in state.data for state in self.heard['slam_state'])

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def test_slam_survives_bad_camera_messages():
    """Each fault is reported on slam_state, and the node goes on: poses, path, points, /tf."""
    made = room.Room(room.camera(320, 240))
    shots = [made.colour_and_depth(pose, number)
             for number, pose in enumerate(room.trajectory(3))]
    (image, depth), blank = shots[0], numpy.zeros((240, 320, 3), numpy.uint8)
    slam = subprocess.Popen(
        [sys.executable, Path(get_package_prefix('fogros2_examples'),
                              'lib/fogros2_examples/slam')])
    side = Side()
    try:
        for what, told in (
                # a frame may meet the next camera info: it must not be one that starts the map
                (lambda: side.show(image, depth * 0, info=CameraInfo()), 'no focal length'),
                (lambda: side.show(image, depth * 0), 'features have a depth'),
                (lambda: side.show(blank, depth), '0 features in the image'),
                (lambda: side.show(image[:, :, :2], depth, 'yuv422'), "an image as 'yuv422'"),
                (lambda: side.show(image[::2], depth[::2]), 'an image of 320x120 from a camera')):
            side.until(lambda told=told: side.said(told), told, what)
        assert side.heard['pose'] == []
        side.until(lambda: side.heard['pose'], 'a pose', lambda: side.show(image, depth))
        side.until(lambda: side.said('lost: 0 features'), 'it to be lost',
                   lambda: side.show(blank, depth))
        since = side.stamp
        side.until(lambda: side.heard['pose'][-1].header.stamp.sec > since, 'it to be found',
                   lambda: side.show(*shots[2]))
        side.until(lambda: side.heard['map_points'] and side.heard['path']
                   and side.heard['path'][-1].header.stamp.sec > since, 'path and points')
        assert side.heard['pose'][0].header.frame_id == 'map'
        for transforms in side.heard.get('/tf', [])[:1]:
            (transform,) = transforms.transforms
            assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'eye')
        assert side.heard['map_points'][-1].width > 100
        moved = messages.matrix(side.heard['path'][-1].poses[-1].pose)
        truth = [pose[:3, 3] for pose in room.trajectory(3)]
        assert numpy.linalg.norm(moved[:3, 3]) == pytest.approx(
            numpy.linalg.norm(truth[2] - truth[0]), abs=0.05)
        assert slam.poll() is None
    finally:
        side.close()
        slam.send_signal(signal.SIGINT)
        assert slam.wait(60) == 0
