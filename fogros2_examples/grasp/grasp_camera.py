# SPDX-License-Identifier: Apache-2.0
"""
A depth camera over synthetic bins: has grasps planned in each and takes the time.

Publishes ``depth`` and ``camera_info``; shows what it gets on ``picture`` and in a file.
"""

from __future__ import annotations

import array
from collections.abc import Callable
import itertools
import json
import time
from typing import Any, Optional

from builtin_interfaces.msg import Time
import cv2
from diagnostic_msgs.msg import DiagnosticStatus
import numpy
from numpy.typing import NDArray
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from fogros2_examples.grasp.bins import camera, depth_image, thrown
from fogros2_examples.grasp.messages import (
    depth_message,
    ENCODINGS,
    grasps_of,
    info_message,
)
from fogros2_examples.grasp.picture import beside, picture
from fogros2_examples.parameters import BadParameter, PICTURES, within, writable

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class GraspCamera(Node):
    """
    The camera.

    Parameters: ``trials``, bins to show, 0 for ever more; ``seed`` of the first; ``encoding``,
    16UC1 (mm) or 32FC1 (m); ``picture``, a PNG file to write, '' for none; ``figures``, a file to
    which each trial's times go, as a line of JSON; ``wait`` in s, how long an answer may take.
    """

    def __init__(self) -> None:
        super().__init__('grasp_camera')
        self.trials = within(self, 'trials', 10, 0)
        self.seed = within(self, 'seed', 0, 0)
        self.encoding = str(self.declare_parameter('encoding', '16UC1').value)
        if self.encoding not in ENCODINGS:
            raise BadParameter(
                f"'encoding' is '{self.encoding}': it has to be {', '.join(ENCODINGS)}")
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
        """Keep how long the planner took."""
        self.ready = True
        told = {value.key: value.value for value in status.values}
        if 'stamp' in told:
            second, _, rest = told['stamp'].partition('.')
            self.seconds[int(second), int(rest)] = float(told['seconds'])

    def answer(self, markers: MarkerArray) -> None:
        """Keep grasps under the stamp of their image."""
        if markers.markers:
            self.answers[_key(markers.markers[0].header.stamp)] = markers

    def run(self) -> int:
        """Return the exit status: 0 where every bin was answered with a grasp."""
        if not self._until(lambda: self.ready, self.wait):
            self.get_logger().fatal(f'no grasp planner is there after {self.wait:g} s')
            return 2
        # what carries the images may not be up when the planner is: the first don't count
        first = self._bin(self.seed)
        if not any(self._asked(first, 5.0) is not None for _ in range(max(1, int(self.wait / 5)))):
            self.get_logger().fatal(f'no depth image was answered in {self.wait:g} s')
            return 2
        found, pictures = 0, []
        for number in range(self.trials) if self.trials else itertools.count():
            depth = self._bin(self.seed + number)
            begin = time.monotonic()
            key = self._asked(depth, self.wait)
            total = time.monotonic() - begin
            if key is None:
                self.get_logger().error(f'bin {number}: no answer in {self.wait:g} s')
                continue
            grasps = grasps_of(self.answers.pop(key))
            found += bool(grasps)
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
            self._show(drawn)
            if self.trials:
                pictures.append(drawn)
        if self.picture and pictures:
            if cv2.imwrite(self.picture, beside(pictures)):
                self.get_logger().info(f'wrote {self.picture}')
            else:
                self.get_logger().error(f'{self.picture} can not be written')
                return 1
        return 0 if found == self.trials else 1

    def _bin(self, seed: int) -> NDArray[numpy.float32]:
        return depth_image(thrown(seed), self.eye, seed)

    def _asked(self, depth: NDArray[numpy.float32], wait: float) -> Optional[tuple[int, int]]:
        """Publish an image; return its stamp when grasps for it are there, None if they aren't."""
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id='camera')
        key = _key(header.stamp)
        height, width = depth.shape
        self.infos.publish(info_message(width, height, self.eye.focal, header))
        self.images.publish(depth_message(depth, self.encoding, header))
        there = self._until(lambda: key in self.answers and key in self.seconds, wait)
        return key if there else None

    def _show(self, image: NDArray[numpy.uint8]) -> None:
        height, width = image.shape[:2]
        self.pictures.publish(Image(
            header=Header(stamp=self.get_clock().now().to_msg(), frame_id='camera'),
            height=height, width=width, encoding='bgr8', step=3 * width,
            data=array.array('B', image.tobytes())))

    def _until(self, true: Callable[[], bool], wait: float) -> bool:
        """Handle messages until something is true; return whether it came to be in time."""
        deadline = time.monotonic() + wait
        while not true():
            if time.monotonic() > deadline:
                return False
            rclpy.spin_once(self, timeout_sec=0.1)
        return True


def _key(stamp: Time) -> tuple[int, int]:
    return stamp.sec, stamp.nanosec


def main() -> None:
    """Run until all bins were shown; a parameter that is none ends it at once."""
    rclpy.init()
    try:
        raise SystemExit(GraspCamera().run())
    except BadParameter as error:
        raise SystemExit(f'grasp_camera: {error}') from error
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # the signal shuts rclpy down, in a thread of its own: a second one may be in its way
    except SystemExit:
        rclpy.try_shutdown()
        raise
