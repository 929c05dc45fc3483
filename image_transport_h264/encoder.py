# SPDX-License-Identifier: Apache-2.0
"""
The node beside the publisher: takes images, publishes them coded.

Subscribes to ``image`` (remap it) and publishes ``<image>/h264``, or what the parameter ``stream``
names; see doc/h264.md for all topics and parameters.
"""

from __future__ import annotations

import signal
from typing import Optional

import rclpy
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import CameraInfo, Image

from image_transport_h264 import memory
from image_transport_h264.lazy import IMAGE_QOS, LazyNode, Relay, Tap
from image_transport_h264.message import CAMERA_INFO, camera_info_topic
from image_transport_h264.senders import make_sender
from image_transport_h264.worker import Worker


class EncoderNode(LazyNode):
    """Hands images to a worker thread, the newest if there are several, while anybody listens."""

    def __init__(self) -> None:
        super().__init__('h264_encoder')
        topic = self.resolve_topic_name('image')
        codec = str(self.declare_parameter('codec', 'h264').value)
        stream = str(self.declare_parameter('stream', '').value) or f'{topic}/{codec}'
        self._sender = make_sender(self, codec, stream, self._listeners_changed)
        self._worker: Worker[Image] = Worker('encode', self._sender.send, self.fail)
        self._images = Tap(self, Image, topic, IMAGE_QOS, self._worker.put)
        # not every image has a camera that describes itself: this too only while it is wanted
        self._infos: Optional[Relay] = None
        if self.declare_parameter('camera_info', True).value:
            self._infos = Relay(self, CameraInfo, camera_info_topic(topic),
                                f'{stream}/{CAMERA_INFO}', IMAGE_QOS)
        self._listeners_changed()
        self.get_logger().info(f'{topic} goes out as {stream} ({codec})')

    def destroy_node(self) -> None:
        """End the worker, then the node."""
        self._worker.stop()
        super().destroy_node()

    def _listeners_changed(self) -> None:
        self._images.want(self._sender.listeners() > 0)


def main() -> None:
    """Run until interrupted."""
    memory.keep()
    rclpy.init()
    node = EncoderNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # what causes it shuts rclpy down, in a thread of its own: not twice
    finally:
        # a second one must not end this halfway
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        failed = node.failed
        node.destroy_node()
    if failed:
        raise SystemExit(1)
