# SPDX-License-Identifier: Apache-2.0
"""
Decode a stream on the subscriber's side, and publish its point clouds.

The node publishes ``points`` (remap it) from ``<points>/pointcloud``, or from the topic in the
parameter ``stream``. See doc/point_clouds.md for all topics and parameters.
"""

from __future__ import annotations

import secrets

from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import CompressedImage, PointCloud2
from std_msgs.msg import UInt64MultiArray

from image_transport_h264.budget import Announcement
from image_transport_h264.cdr import CdrError, Header
from image_transport_h264.lazy import IMAGE_QOS, LazyNode, run, STREAM_QOS, Tap
from image_transport_h264.message import coded
from point_cloud_stream import message
from point_cloud_stream.cloud import CloudError, MAX_BYTES
from point_cloud_stream.codec import decode, FORMAT
from point_cloud_stream.parts import Assembler, FEEDBACK


class DecoderNode(LazyNode):
    """Decode the newest cloud in a worker thread, while the points have a subscriber."""

    def __init__(self) -> None:
        super().__init__('point_cloud_decoder')
        topic = self.resolve_topic_name('points')
        stream = str(self.declare_parameter('stream', '').value) or f'{topic}/{FORMAT}'
        self._max_bytes = int(self.declare_parameter('max_bytes', MAX_BYTES, ParameterDescriptor(
            description='larger clouds are not decoded', read_only=True)).value)
        self._announcement = Announcement(self, stream)
        self._assembler = Assembler(self._max_bytes)
        self._identity = secrets.randbits(63)
        self._feedback = self.create_publisher(
            UInt64MultiArray, f'{stream}/{FEEDBACK}', STREAM_QOS)
        self._worker = self.start_worker('decode', self._decode)
        self._parts = Tap(self, CompressedImage, stream, STREAM_QOS, self._part, adapt=False)
        self._points = self.offer(PointCloud2, topic, IMAGE_QOS, self._matched)
        self._matched()
        self.get_logger().info(f'{stream} comes in as {topic}')

    def _matched(self) -> None:
        self._parts.want(self._announcement.want(self.subscribers(self._points) > 0))

    def _part(self, part: bytes) -> None:
        try:
            header, _, data = coded(part)
        except CdrError as error:
            self.complain(str(error), f'part of a cloud not used: {error}')
            return
        acknowledge, whole = self._assembler.add(bytes(data))
        if acknowledge is not None:
            self.put_out(self._feedback, UInt64MultiArray(
                data=[acknowledge[0], self._identity, acknowledge[1]]))
        if whole is not None:
            self._worker.put((header, whole))

    def _decode(self, item: tuple[Header, bytes]) -> None:
        header, data = item
        try:
            layout, octets = decode(data, self._max_bytes)
        except CloudError as error:
            self.complain(str(error), f'cloud not shown: {error}')
            return
        self.put_out(self._points, message.points(header, layout, octets))


def main() -> None:
    """Run the node until a signal."""
    run(DecoderNode)
