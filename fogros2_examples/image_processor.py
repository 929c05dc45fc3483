# SPDX-License-Identifier: Apache-2.0
"""Find features in the images on ``camera``, and publish them drawn on ``annotated``."""

from __future__ import annotations

import array
import time

import cv2
import numpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

from fogros2_examples.nodes import run


class ImageProcessor(Node):
    """Find corners; parameter ``features`` is the maximum number per image."""

    def __init__(self) -> None:
        super().__init__('image_processor')
        self.features = int(self.declare_parameter('features', 300).value)
        self.seen = 0
        self.since = time.monotonic()
        self.annotated = self.create_publisher(Image, 'annotated', 2)
        self.create_subscription(Image, 'camera', self.process, qos_profile_sensor_data)

    def process(self, image: Image) -> None:
        """Publish the image with its features, with the same stamp."""
        if image.encoding != 'bgr8':
            self.get_logger().error(f'{image.encoding} images are not for me', once=True)
            return
        pixels = numpy.frombuffer(image.data, numpy.uint8).reshape(image.height, image.step)
        colours = pixels[:, :3 * image.width].reshape(image.height, image.width, 3)
        grey = cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY)
        points = cv2.goodFeaturesToTrack(grey, self.features, 0.01, 8)
        corners = numpy.empty((0, 2), int) if points is None else points.reshape(-1, 2).astype(int)
        drawn = colours.copy()
        for x, y in corners:
            cv2.circle(drawn, (int(x), int(y)), 3, (0, 255, 0), 1, cv2.LINE_AA)
        self.annotated.publish(Image(
            header=image.header, height=image.height, width=image.width, encoding='bgr8',
            step=3 * image.width, data=array.array('B', drawn.tobytes())))
        self.seen += 1
        if self.seen % 30 == 0:
            now = time.monotonic()
            stamp = image.header.stamp
            late = self.get_clock().now().nanoseconds / 1e9 - stamp.sec - stamp.nanosec / 1e9
            self.get_logger().info(
                f'{30 / (now - self.since):.1f} images/s, {len(corners)} features in the last '
                f'one, {1000 * late:.0f} ms after it was taken')
            self.since = now


def main() -> None:
    """Run until interrupted."""
    run('image_processor', ImageProcessor)
