# SPDX-License-Identifier: Apache-2.0
"""Publish images on ``camera``: a synthetic scene, a video file, or a V4L2 device."""

from __future__ import annotations

from collections.abc import Iterator
import itertools
from pathlib import Path

import cv2
import numpy
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from fogros2_examples.letterbox import letterbox, Pixels
from fogros2_examples.nodes import run
from fogros2_examples.scene import Scene
from fogros2_examples.slam.geometry import Camera as Lens
from fogros2_examples.slam.messages import camera_info, image


def synthetic(width: int, height: int, rate: float) -> Iterator[Pixels]:
    """Yield the frames of the synthetic scene."""
    scene = Scene(width, height, rate)
    return (scene.frame(number) for number in itertools.count())


def captured(source: str, width: int, height: int) -> Iterator[Pixels]:
    """
    Yield the frames of a device (``/dev/video0``), or of a file in an endless loop, letterboxed.

    :param width: width of the frames in pixels, as ``height``.
    :raises RuntimeError: the source cannot be opened, or has no frame.
    """
    device = Path(source).is_char_device()
    while True:
        capture = cv2.VideoCapture(source, cv2.CAP_V4L2 if device else cv2.CAP_ANY)
        if device:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        read = 0
        try:
            while True:
                readable, picture = capture.read()
                if not readable:
                    break
                frame = numpy.asarray(picture, numpy.uint8)
                if device and not read:
                    width, height = frame.shape[1], frame.shape[0]
                if frame.shape[:2] != (height, width):
                    frame = letterbox(frame, width, height)
                read += 1
                yield frame
        finally:
            capture.release()
        if not read or device:
            raise RuntimeError(f'{source} gives no picture')


class Camera(Node):
    """A camera; an image and its CameraInfo have the same stamp."""

    def __init__(self) -> None:
        super().__init__('camera')
        source = str(self.declare_parameter('source', 'synthetic').value)
        width = int(self.declare_parameter('width', 640).value)
        height = int(self.declare_parameter('height', 480).value)
        rate = float(self.declare_parameter('rate', 30.0).value)
        self.remaining = int(self.declare_parameter('count', 0).value)
        self.counted = self.remaining > 0
        self.frame_id = str(self.declare_parameter('frame_id', 'camera').value)
        self.frames = (synthetic(width, height, rate) if source == 'synthetic'
                       else captured(source, width, height))
        self.lens = Lens(width, height, float(width), float(width), width / 2, height / 2)
        self.images = self.create_publisher(Image, 'camera', 2)
        self.infos = self.create_publisher(CameraInfo, 'camera_info', 2)
        self.next = next(self.frames)
        self.create_timer(1 / rate, self.shoot)

    def shoot(self) -> None:
        """Publish a frame, then render the next one."""
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.frame_id)
        self.images.publish(image(header, self.next, 'bgr8'))
        self.infos.publish(camera_info(header, self.lens, False))
        if self.counted:
            self.remaining -= 1
            if not self.remaining:
                raise SystemExit(0)
        self.next = next(self.frames)


def main() -> None:
    """Run until a signal, or until ``count`` images are published."""
    run('camera', Camera)
