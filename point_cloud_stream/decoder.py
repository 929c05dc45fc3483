# SPDX-License-Identifier: Apache-2.0
"""
Decode a stream on the subscriber's side, and publish its point clouds.

The node publishes ``points`` (remap it) from ``<points>/pointcloud``, or from the topic in the
parameter ``stream``. See doc/point_clouds.md for all topics and parameters.
"""

from __future__ import annotations

from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import CompressedImage, PointCloud2

from image_transport_h264.budget import Announcement
from image_transport_h264.cdr import CdrError
from image_transport_h264.lazy import IMAGE_QOS, LazyNode, run, Tap
from image_transport_h264.message import coded
from image_transport_h264.slices import SliceReceiver
from point_cloud_stream import message
from point_cloud_stream.cloud import CloudError, MAX_BYTES
from point_cloud_stream.codec import decode, FORMAT


class DecoderNode(LazyNode):
    """Decode the newest cloud in a worker thread, while the points have a subscriber."""

    def __init__(self) -> None:
        super().__init__('point_cloud_decoder')
        topic = self.resolve_topic_name('points')
        stream = str(self.declare_parameter('stream', '').value) or f'{topic}/{FORMAT}'
        self._max_bytes = int(self.declare_parameter('max_bytes', MAX_BYTES, ParameterDescriptor(
            description='larger clouds are not decoded', read_only=True,
            dynamic_typing=True)).value)
        self._announcement = Announcement(self, stream)
        put = self.start_worker('decode', self._decode).put
        self._taps = [Tap(self, CompressedImage, stream, IMAGE_QOS, put),
                      SliceReceiver(self, stream, put, self._max_bytes).tap]
        self._points = self.offer(PointCloud2, topic, IMAGE_QOS, self._matched)
        self._matched()
        self.get_logger().info(f'{stream} comes in as {topic}')

    def _matched(self) -> None:
        wanted = self._announcement.want(self.subscribers(self._points) > 0)
        for tap in self._taps:
            tap.want(wanted)

    def _decode(self, cloud: bytes) -> None:
        try:
            header, _, data = coded(cloud)
            layout, octets = decode(bytes(data), self._max_bytes)
        except (CdrError, CloudError) as error:
            self.complain(str(error), f'cloud not shown: {error}')
            return
        self.put_out(self._points, message.points(header, layout, octets))


def main() -> None:
    """Run the node until a signal."""
    run(DecoderNode)
