# SPDX-License-Identifier: Apache-2.0
"""Looks for features in the images on ``camera``, publishes them drawn in on ``annotated``."""

from __future__ import annotations

import array
import time

import cv2
import numpy
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image


class ImageProcessor(Node):
    """Finds ORB features; parameter ``features`` is the most it looks for in an image."""

    def __init__(self) -> None:
        super().__init__('image_processor')
        features = int(self.declare_parameter('features', 300).value)
        self.orb = cv2.ORB_create(nfeatures=features)
        self.seen = 0
        self.since = time.monotonic()
        self.annotated = self.create_publisher(Image, 'annotated', 2)
        self.create_subscription(Image, 'camera', self.process, qos_profile_sensor_data)

    def process(self, image: Image) -> None:
        """Publish the image with its features, under the stamp that it came with."""
        if image.encoding != 'bgr8':
            self.get_logger().error(f'{image.encoding} images are not for me', once=True)
            return
        pixels = numpy.frombuffer(image.data, numpy.uint8).reshape(image.height, image.step)
        colours = pixels[:, :3 * image.width].reshape(image.height, image.width, 3)
        points = self.orb.detect(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY), None)
        drawn = cv2.drawKeypoints(colours, points, None, (0, 255, 0))
        self.annotated.publish(Image(
            header=image.header, height=image.height, width=image.width, encoding='bgr8',
            step=3 * image.width, data=array.array('B', drawn.tobytes())))
        self.seen += 1
        if self.seen % 30 == 0:
            now = time.monotonic()
            stamp = image.header.stamp
            late = self.get_clock().now().nanoseconds / 1e9 - stamp.sec - stamp.nanosec / 1e9
            self.get_logger().info(
                f'{30 / (now - self.since):.1f} images/s, {len(points)} features in the last '
                f'one, {1000 * late:.0f} ms after it was taken')
            self.since = now


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    try:
        rclpy.spin(ImageProcessor())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
