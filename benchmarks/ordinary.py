# SPDX-License-Identifier: Apache-2.0
"""
H.264 for comparison: our codec between nodes that are written as most nodes of rclpy are.

``encode`` takes images on ``camera`` and publishes a packet for each; ``decode`` publishes
``decoded``. Both handle messages as Python objects, and neither adapts to the link.
"""

from __future__ import annotations

import array
import sys
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from image_transport_h264.codec import Decoder, Encoder, Picture


class Encode(Node):
    """Images to packets."""

    def __init__(self) -> None:
        super().__init__('ordinary_encode')
        self.encoder = Encoder()
        self.publisher = self.create_publisher(CompressedImage, 'camera/stream', 8)
        self.create_subscription(Image, 'camera', self.take, 2)

    def take(self, image: Any) -> None:
        """Encode an image and publish its packet, once somebody listens: the first is a key."""
        if self.publisher.get_subscription_count():
            packet = self.encoder.encode(Picture(
                image.width, image.height, image.encoding, image.step, memoryview(image.data)))
            self.publisher.publish(CompressedImage(
                header=image.header, format='h264', data=array.array('B', packet.data)))


class Decode(Node):
    """Packets to images."""

    def __init__(self) -> None:
        super().__init__('ordinary_decode')
        self.decoder = Decoder()
        self.publisher = self.create_publisher(Image, 'decoded', 2)
        self.create_subscription(CompressedImage, 'camera/stream', self.take, 8)

    def take(self, packet: Any) -> None:
        """Decode a packet and publish its picture."""
        picture = self.decoder.decode(packet.data)
        if picture is not None:
            self.publisher.publish(Image(
                header=packet.header, width=picture.width, height=picture.height,
                step=picture.step, encoding=picture.encoding,
                data=array.array('B', bytes(picture.data))))


def main() -> None:
    """Run one of the two."""
    rclpy.init()
    try:
        rclpy.spin(Encode() if sys.argv[1] == 'encode' else Decode())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
