# SPDX-License-Identifier: Apache-2.0
"""
Decode a stream on the subscriber's side, and publish its images.

The node publishes ``image`` (remap it) from ``<image>/h264``, or from the topic in the parameter
``stream``. See doc/h264.md for all topics and parameters.
"""

from __future__ import annotations

import functools
from typing import Optional

from sensor_msgs.msg import CameraInfo, Image

from image_transport_h264.budget import Announcement
from image_transport_h264.lazy import IMAGE_QOS, LazyNode, Relay, run
from image_transport_h264.message import CAMERA_INFO, camera_info_topic
from image_transport_h264.receivers import make_receiver


class DecoderNode(LazyNode):
    """Decode in a worker thread, while the images have a subscriber."""

    def __init__(self) -> None:
        super().__init__('h264_decoder')
        topic = self.resolve_topic_name('image')
        codec = str(self.declare_parameter('codec', 'h264').value)
        stream = str(self.declare_parameter('stream', '').value) or f'{topic}/{codec}'
        self._images = self.offer(Image, topic, IMAGE_QOS, self._listeners_changed)
        self._announcement = Announcement(self, stream)
        self._receiver = make_receiver(
            self, codec, stream, functools.partial(self.put_out, self._images))
        self._infos: Optional[Relay] = None
        if self.declare_parameter('camera_info', True).value:
            self._infos = Relay(self, CameraInfo, f'{stream}/{CAMERA_INFO}',
                                camera_info_topic(topic), IMAGE_QOS)
        self._listeners_changed()
        self.get_logger().info(f'{stream} ({codec}) comes in as {topic}')

    def _listeners_changed(self) -> None:
        self._receiver.want(self._announcement.want(self.subscribers(self._images) > 0))


def main() -> None:
    """Run the node until a signal."""
    run(DecoderNode)
