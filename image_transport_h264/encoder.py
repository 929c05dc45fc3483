# SPDX-License-Identifier: Apache-2.0
"""
Encode images on the publisher's side, and publish the stream.

The node subscribes to ``image`` (remap it), and publishes ``<image>/h264``, or the topic in the
parameter ``stream``. See doc/h264.md for all topics and parameters. The parameter ``topic`` is
the name of ``image`` in log messages.
"""

from __future__ import annotations

import difflib
from typing import Optional

from sensor_msgs.msg import CameraInfo, Image

from image_transport_h264.lazy import every, IMAGE_QOS, LazyNode, Relay, run, Tap
from image_transport_h264.message import CAMERA_INFO, camera_info_topic
from image_transport_h264.senders import make_sender

#: Seconds until the node reports a topic without a publisher.
PATIENCE = 5.0


class EncoderNode(LazyNode):
    """Encode the newest image in a worker thread, while the stream has a subscriber."""

    def __init__(self) -> None:
        super().__init__('h264_encoder')
        topic = self.resolve_topic_name('image')
        codec = str(self.declare_parameter('codec', 'h264').value)
        stream = str(self.declare_parameter('stream', '').value) or f'{topic}/{codec}'
        self._sender = make_sender(self, codec, stream, self._listeners_changed)
        worker = self.start_worker('encode', self._sender.send)
        self._images = Tap(self, Image, topic, IMAGE_QOS, worker.put)
        # Many cameras publish no CameraInfo, so subscribe to it only on request.
        self._infos: Optional[Relay] = None
        if self.declare_parameter('camera_info', True).value:
            self._infos = Relay(self, CameraInfo, camera_info_topic(topic),
                                f'{stream}/{CAMERA_INFO}', IMAGE_QOS)
        self._listeners_changed()
        named = str(self.declare_parameter('topic', '').value) or topic
        self._look = every(self, PATIENCE, lambda: self._look_for_images(topic, named))
        self.get_logger().info(f'{topic} goes out as {stream} ({codec})')

    def _look_for_images(self, topic: str, named: str) -> None:
        """Warn once if nobody publishes images, and name the most similar topic with images."""
        self._look.cancel()
        if self.count_publishers(topic):
            return
        others = [name for name, kinds in self.get_topic_names_and_types()
                  # the topics below /fogros2 are the streams' own copies
                  if 'sensor_msgs/msg/Image' in kinds and name != topic
                  and not name.startswith('/fogros2/') and self.count_publishers(name)]
        near = difflib.get_close_matches(named, others, n=1)
        guess = f' (did you mean {near[0]}?)' if near else ''
        self.get_logger().warning(f'no images on {named}{guess}')

    def _listeners_changed(self) -> None:
        self._images.want(self._sender.listeners() > 0)


def main() -> None:
    """Run the node until a signal."""
    run(EncoderNode)
