# SPDX-License-Identifier: Apache-2.0
"""
Publish depth images of synthetic bins, and measure the time until the grasps arrive.

The node publishes ``depth`` and ``camera_info``. It shows the grasps on ``picture`` and in a file.
"""

from __future__ import annotations

import itertools
import json
import time
from typing import Any, Optional

from builtin_interfaces.msg import Time
import cv2
from diagnostic_msgs.msg import DiagnosticStatus
import numpy
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from fogros2_examples.files import PICTURES
from fogros2_examples.grasp.bins import camera, depth_image, thrown
from fogros2_examples.grasp.messages import depth_message, grasps_of, info_message
from fogros2_examples.grasp.picture import beside, picture
from fogros2_examples.nodes import LATCHED, run, until
from fogros2_examples.parameters import BadParameter, within, writable
from fogros2_examples.slam.messages import DEPTHS, image

#: Seconds for the answer to the first image; each further one gets twice as long.
FIRST_PAUSE = 5.0


class GraspCamera(Node):
    """
    The camera.

    Parameters: ``trials``, number of bins, 0 for no end; ``seed`` of the first bin; ``encoding``,
    16UC1 (mm) or 32FC1 (m); ``picture``, a PNG file to write, '' for none; ``figures``, a file for
    the times of each trial, as lines of JSON; ``wait``, time-out of an answer in s.
    """

    def __init__(self) -> None:
        super().__init__('grasp_camera')
        self.trials = within(self, 'trials', 10, 0)
        self.seed = within(self, 'seed', 0, 0)
        self.encoding = str(self.declare_parameter('encoding', '16UC1').value)
        if self.encoding not in DEPTHS:
            raise BadParameter(
                f"'encoding' is '{self.encoding}': it has to be {', '.join(DEPTHS)}")
        self.picture = writable(self, 'picture', PICTURES)
        self.figures = writable(self, 'figures')
        self.wait = within(self, 'wait', 60.0, 0.1)
        self.eye = camera()
        self.ready = False
        self.seconds: dict[tuple[int, int], float] = {}
        self.answers: dict[tuple[int, int], MarkerArray] = {}
        self.images = self.create_publisher(Image, 'depth', 2)
        self.infos = self.create_publisher(CameraInfo, 'camera_info', 10)
        self.pictures = self.create_publisher(Image, 'picture', LATCHED)
        self.create_subscription(MarkerArray, 'grasp_markers', self.answer, 10)
        self.create_subscription(DiagnosticStatus, 'grasp_status', self.hear, LATCHED)

    def hear(self, status: DiagnosticStatus) -> None:
        """Record the planner's time for an image."""
        self.ready = True
        told = {value.key: value.value for value in status.values}
        if 'stamp' in told:
            second, _, rest = told['stamp'].partition('.')
            self.seconds[int(second), int(rest)] = float(told['seconds'])

    def answer(self, markers: MarkerArray) -> None:
        """Record the grasps of an image by the image's stamp."""
        if markers.markers:
            self.answers[_key(markers.markers[0].header.stamp)] = markers

    def run(self) -> int:
        """Show all bins, and return the exit status: 0 if each bin had a grasp."""
        if not until(self, lambda: self.ready, self.wait):
            self.get_logger().fatal(f'no grasp planner is there after {self.wait:g} s')
            return 2
        if not self._warm_up(self._bin(self.seed)):
            self.get_logger().fatal(f'no depth image was answered in {self.wait:g} s')
            return 2
        solved, pictures = 0, []
        for number in range(self.trials) if self.trials else itertools.count():
            depth = self._bin(self.seed + number)
            begin = time.monotonic()
            key = self._asked(depth, self.wait)
            total = time.monotonic() - begin
            if key is None:
                self.get_logger().error(f'bin {number}: no answer in {self.wait:g} s')
                continue
            grasps = grasps_of(self.answers.pop(key))
            solved += bool(grasps)
            best = f'q {grasps[0].quality:.2f}' if grasps else 'no grasp'
            self.get_logger().info(
                f'bin {number}: {len(grasps)} grasps, {best}; {total:.3f} s, '
                f'{self.seconds[key]:.3f} s of it planning')
            if self.figures:
                figures: dict[str, Any] = {'trial': number, 'total': total,
                                           'seconds': self.seconds[key], 'grasps': len(grasps)}
                with open(self.figures, 'a') as file:
                    file.write(json.dumps(figures) + '\n')
            drawn = picture(depth, grasps, self.eye.focal, f'bin {number}: {best}')
            header = Header(stamp=self.get_clock().now().to_msg(), frame_id='camera')
            self.pictures.publish(image(header, drawn, 'bgr8'))
            if self.trials:
                pictures.append(drawn)
        if self.picture and pictures:
            if cv2.imwrite(self.picture, beside(pictures)):
                self.get_logger().info(f'wrote {self.picture}')
            else:
                self.get_logger().error(f'{self.picture} can not be written')
                return 1
        return 0 if solved == self.trials else 1

    def _bin(self, seed: int) -> NDArray[numpy.float32]:
        return depth_image(thrown(seed), self.eye, seed)

    def _asked(self, depth: NDArray[numpy.float32], wait: float) -> Optional[tuple[int, int]]:
        """Publish an image; return its stamp after its grasps arrived, None after ``wait`` s."""
        key = self._published(depth)
        return key if until(self, lambda: self._answered(key), wait) else None

    def _warm_up(self, depth: NDArray[numpy.float32]) -> bool:
        """
        Publish an image until one is answered, however late; return whether one was.

        The transport of the images may start later than the planner and lose the first images;
        a slow planner answers the first image when others have followed.
        """
        keys: list[tuple[int, int]] = []
        deadline, pause = time.monotonic() + self.wait, FIRST_PAUSE
        while not any(map(self._answered, keys)):
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            keys.append(self._published(depth))
            until(self, lambda: any(map(self._answered, keys)), min(pause, left))
            pause *= 2
        # the first bin's time must not include the planner's time for these images
        others = (len(keys) - 1) * (max(self.seconds.values()) + 1.0)
        until(self, lambda: all(map(self._answered, keys)), others)
        return True

    def _answered(self, key: tuple[int, int]) -> bool:
        return key in self.answers and key in self.seconds

    def _published(self, depth: NDArray[numpy.float32]) -> tuple[int, int]:
        """Publish an image, and return its stamp."""
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id='camera')
        key = _key(header.stamp)
        height, width = depth.shape
        self.infos.publish(info_message(width, height, self.eye.focal, header))
        self.images.publish(depth_message(depth, self.encoding, header))
        return key


def _key(stamp: Time) -> tuple[int, int]:
    return stamp.sec, stamp.nanosec


def main() -> None:
    """Show all bins; exit at once on an invalid parameter."""
    run('grasp_camera', GraspCamera, GraspCamera.run)
