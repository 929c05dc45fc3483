# SPDX-License-Identifier: Apache-2.0
"""
Encode point clouds on the publisher's side, and publish the stream.

The node subscribes to ``points`` (remap it), and publishes ``<points>/pointcloud``, or the topic
in the parameter ``stream``. See doc/point_clouds.md for all topics and parameters.
"""

from __future__ import annotations

import functools
import time
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import CompressedImage, PointCloud2

from image_transport_h264.budget import Budget
from image_transport_h264.cdr import CdrError
from image_transport_h264.lazy import IMAGE_QOS, LazyNode, run, STREAM_QOS, Tap
from image_transport_h264.message import compressed
from image_transport_h264.slices import SliceSender
from point_cloud_stream import message
from point_cloud_stream.cloud import CloudError, MAX_BYTES
from point_cloud_stream.codec import Coded, encode, FORMAT
from point_cloud_stream.control import Control

PARAMETERS: dict[str, Any] = {'stream': '', 'topic': '', 'resolution': 0.001, 'lossless': False,
                              'max_rate': 0.0, 'drop_fields': '', 'max_bytes': MAX_BYTES}


class EncoderNode(LazyNode):
    """Encode the newest cloud in a worker thread, while the stream has a subscriber."""

    def __init__(self) -> None:
        super().__init__('point_cloud_encoder')
        values = {name: self.declare_parameter(
            name, default, ParameterDescriptor(read_only=True, dynamic_typing=True)).value
            for name, default in PARAMETERS.items()}
        topic = self.resolve_topic_name('points')
        stream = str(values['stream']) or f'{topic}/{FORMAT}'
        self._named = str(values['topic']) or topic
        self._drop = frozenset(filter(None, str(values['drop_fields']).split(',')))
        self._control = Control(0.0 if values['lossless'] else float(values['resolution']),
                                float(values['max_rate']))
        self._max_bytes = int(values['max_bytes'])
        self._worker = self.start_worker('encode', self._send)
        self._clouds = Tap(self, PointCloud2, topic, IMAGE_QOS, self._take)
        self._publisher = self.offer(CompressedImage, stream, STREAM_QOS, self._matched)
        self._slices = SliceSender(self, stream, self._matched, fine=True)
        self._budget = Budget(self, stream, lambda: self.subscribers(self._publisher))
        self._matched()
        self.get_logger().info(f'{topic} goes out as {stream}')

    # --- in the executor's thread

    def _matched(self) -> None:
        self._clouds.want(self.subscribers(self._publisher) > 0)

    def _take(self, cloud: bytes) -> None:
        if self._control.arrived(time.monotonic()):
            self._worker.put(cloud)

    # --- in the worker's thread

    def _send(self, cloud: bytes) -> None:
        """Encode and publish a cloud, slice by slice as share and link take them."""
        try:
            header, layout, points = message.cloud(cloud)
            coded = encode(
                layout, points, self._control.resolution, self._drop, self._max_bytes)
        except (CdrError, CloudError) as error:
            self.complain(str(error), f'cloud of {self._named} not sent: {error}')
            return
        self._slices.send_to_all(
            self._publisher, compressed(header, FORMAT, coded.data),
            functools.partial(self._leaves, coded),
            lambda seconds, quickest: self._control.crossed(
                coded, seconds, quickest, time.monotonic()))

    def _leaves(self, coded: Coded, size: int) -> None:
        self._budget.pace()
        self._budget.sent(size, 8.0 * len(coded.data), self._control.latency,
                          short=self._control.resolution > self._control.asked)


def main() -> None:
    """Run the node until a signal."""
    run(EncoderNode)
