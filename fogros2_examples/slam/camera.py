# SPDX-License-Identifier: Apache-2.0
"""
The robot's side of the SLAM example: a camera that measures SLAM's answers.

The node publishes ``camera/image`` with ``camera/depth`` or ``camera/right/image``, and their
camera infos, all with the same stamp. It subscribes to ``pose`` and ``path``. A round trip is the
time from the publication of a frame to the pose with its stamp. With ``wait``, a frame waits for
the pose of the previous frame (of the one ``ahead`` frames before), up to a time-out. So a slow
SLAM is measured as slow, and does not lose track.
At the end, the node reports round trips and accuracy, and draws the trajectory.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
import importlib.util
from itertools import islice
import json
import math
from pathlib import Path
import time
from typing import Optional

import cv2
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
import numpy
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, TimeReference
from std_msgs.msg import Header

from fogros2_examples.files import PICTURES
from fogros2_examples.letterbox import Pixels
from fogros2_examples.nodes import LATCHED, run
from fogros2_examples.parameters import within, writable
from fogros2_examples.slam import messages, sources
from fogros2_examples.slam.evaluation import Accuracy, accuracy
from fogros2_examples.slam.geometry import Array
from fogros2_examples.slam.sources import Shot

#: Time-out of the last poses and of the path, in seconds.
TIMEOUT = 5.0
#: Minimum number of poses for an error.
FEWEST = 3
#: Limits of the size in pixels: ORB needs a margin of 31, codecs accept no larger images.
NARROWEST, WIDEST = 64, 4096
#: Memory limit of the synthetic frames, which are rendered in advance.
BYTES = 4 << 30
#: Frames per second.
SLOWEST, FASTEST = 0.01, 1000


class SlamCamera(Node):
    """Publish frames, collect the answers; ``ended`` is set when both are complete."""

    def __init__(self) -> None:
        super().__init__('slam_camera')
        self.folder = str(self.declare_parameter('dataset', '').value)
        self.picture = writable(self, 'picture', (*PICTURES, '.pdf', '.svg'))
        self.results = writable(self, 'results')
        width = within(self, 'width', 640, NARROWEST, WIDEST)
        height = within(self, 'height', 480, NARROWEST, WIDEST)
        count = (within(self, 'frames', 200, 0) if self.folder else
                 within(self, 'frames', 200, 1, BYTES // (6 * width * height)))
        stereo = bool(self.declare_parameter('stereo', True).value)
        seed = int(self.declare_parameter('seed', 1).value)
        rate = within(self, 'rate', 10.0, SLOWEST, FASTEST)
        self.grey = bool(self.declare_parameter('grey', False).value)
        self.patient = bool(self.declare_parameter('wait', True).value)
        self.ahead = within(self, 'ahead', 1, 1)
        self.frame_id = str(self.declare_parameter('frame_id', 'camera').value)
        if not self.folder:
            self.get_logger().info(f'rendering {count} frames of a room')
        self.source = (sources.dataset(Path(self.folder), count) if self.folder
                       else sources.synthetic(width, height, count, stereo, seed))
        self.reader = ThreadPoolExecutor(1)
        self.next: Future[Optional[Shot]] = self._read()
        self.ended = False
        #: By stamp: time of publication, true pose, time of the answer, and its pose.
        self.sent: dict[int, float] = {}
        self.truth: dict[int, Array] = {}
        self.answered: dict[int, float] = {}
        self.computed: dict[int, float] = {}
        self.live: dict[int, Array] = {}
        self.final: dict[int, Array] = {}
        self.deadline = math.inf
        self.images = self.create_publisher(Image, 'camera/image', 2)
        self.depths = self.create_publisher(Image, 'camera/depth', 2)
        self.rights = self.create_publisher(Image, 'camera/right/image', 2)
        self.infos = self.create_publisher(CameraInfo, 'camera/camera_info', 2)
        self.right_infos = self.create_publisher(CameraInfo, 'camera/right/camera_info', 2)
        self.create_subscription(PoseStamped, 'pose', self._take_pose, 10)
        self.create_subscription(PathMessage, 'path', self._take_path, LATCHED)
        self.create_subscription(TimeReference, 'computing', self._take_time, 10)
        self.create_timer(1 / rate, self._shoot)
        self.get_logger().info(f'{self.source.count} frames of {self.source.camera.width}x'
                               f'{self.source.camera.height} at {rate:g} Hz')

    def _read(self) -> Future[Optional[Shot]]:
        # In a thread, because the executor has to measure the arrival of answers.
        return self.reader.submit(lambda: next(self.source.shots, None))

    def _shoot(self) -> None:
        """Publish a frame if there is a subscriber; after the last frame, wait for answers."""
        if not self.sent and not self.images.get_subscription_count():
            return
        if self.deadline < math.inf:
            last = next(reversed(self.sent), None)
            self.ended = last in self.final or time.monotonic() > self.deadline
            return
        if self.patient and len(self.sent) >= self.ahead:
            before, when = next(islice(reversed(self.sent.items()), self.ahead - 1, None))
            if before not in self.answered and time.perf_counter() - when < TIMEOUT / 2:
                return
        if not self.next.done():
            return  # the disk is slower than the frame rate
        shot = self.next.result()
        if shot is None:
            self.deadline = time.monotonic() + TIMEOUT
            return
        self.next = self._read()
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.frame_id)
        stamp = messages.nanoseconds(header.stamp)
        if shot.truth is not None:
            self.truth[stamp] = shot.truth
        camera = self.source.camera
        image = self._image(header, shot.image)
        self.infos.publish(messages.camera_info(header, camera, False))
        if shot.right is not None:
            right = self._image(header, shot.right)
            self.right_infos.publish(messages.camera_info(header, camera, True))
            self.sent[stamp] = time.perf_counter()
            self.images.publish(image)
            self.rights.publish(right)
        elif shot.depth is not None:
            depth = messages.image(header, shot.depth, '16UC1')
            self.sent[stamp] = time.perf_counter()
            self.images.publish(image)
            self.depths.publish(depth)

    def _image(self, header: Header, pixels: Pixels) -> Image:
        if not self.grey:
            return messages.image(header, pixels, 'bgr8')
        return messages.image(header, cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), 'mono8')

    def _take_pose(self, pose: PoseStamped) -> None:
        now = time.perf_counter()
        stamp = messages.nanoseconds(pose.header.stamp)
        if stamp in self.sent:
            self.answered.setdefault(stamp, now)
            self.live[stamp] = messages.matrix(pose.pose)

    def _take_time(self, taken: TimeReference) -> None:
        self.computed[messages.nanoseconds(taken.header.stamp)] = (
            messages.nanoseconds(taken.time_ref) / 1e9)

    def _take_path(self, path: PathMessage) -> None:
        poses = ((messages.nanoseconds(p.header.stamp), p.pose) for p in path.poses)
        self.final = {stamp: messages.matrix(pose) for stamp, pose in poses if stamp in self.sent}

    def close(self) -> None:
        """Stop the reading thread."""
        self.reader.shutdown(cancel_futures=True)

    def report(self) -> int:
        """
        Log the measurement, write it to ``results``, draw ``picture``; return the exit status.

        :raises OSError: a file cannot be written.
        """
        log = self.get_logger()
        trips = numpy.array([when - self.sent[stamp] for stamp, when in self.answered.items()])
        log.info(f'{len(trips)} of {len(self.sent)} frames were answered')
        if not len(trips):
            log.error("no pose came back: see 'slam_state'")
            return 1
        middle, late = 1e3 * numpy.quantile(trips, [0.5, 0.95])
        log.info(f'round trip: median {middle:.0f} ms, 95 % within {late:.0f} ms')
        live, final = self._accuracy(self.live), self._accuracy(self.final)
        for what, one in (('as they came', live), ('as the map has them in the end', final)):
            if one is not None:
                log.info(f'poses {what}: ATE {100 * one.ate:.2f} cm, RPE {100 * one.rpe:.2f} cm '
                         'over a metre')
        if self.results:
            Path(self.results).write_text(json.dumps({
                'sent': len(self.sent), 'round_trips': [float(trip) for trip in trips],
                'computing': [self.computed.get(stamp, math.nan) for stamp in self.answered],
                # time of arrival, seconds after the first one
                'came': [when - next(iter(self.answered.values()))
                         for when in self.answered.values()],
                **{f'{name}_{error}': getattr(one, error)
                   for name, one in (('live', live), ('final', final)) if one is not None
                   for error in ('ate', 'rpe')}}))
        # Another SLAM algorithm may publish no path.
        drawn = live if final is None else final
        if self.picture and drawn is not None:
            from fogros2_examples.slam.picture import draw
            draw(Path(self.picture), drawn, [1e3 * float(trip) for trip in trips],
                 furnished=not self.folder)
            log.info(f'the trajectory is drawn in {self.picture}')
        return 0

    def _accuracy(self, estimate: dict[int, Array]) -> Optional[Accuracy]:
        both = sorted(estimate.keys() & self.truth.keys())
        if len(both) < FEWEST:
            return None
        if importlib.util.find_spec('evo') is None:
            self.get_logger().warning(
                "no errors and no picture: 'pip install evo' brings what tells them", once=True)
            return None
        return accuracy([self.truth[s] for s in both], [estimate[s] for s in both])


def measure(node: SlamCamera) -> int:
    """Run until all frames are answered; return the exit status."""
    try:
        while not node.ended:
            rclpy.spin_once(node, timeout_sec=0.1)
        return node.report()
    finally:
        node.close()


def main() -> None:
    """Run until all frames are answered or a signal arrives; exit at once on an invalid input."""
    run('slam_camera', SlamCamera, measure)
