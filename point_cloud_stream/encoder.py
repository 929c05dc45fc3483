# SPDX-License-Identifier: Apache-2.0
"""
Encode point clouds on the publisher's side, and publish the stream.

The node subscribes to ``points`` (remap it), and publishes ``<points>/pointcloud``, or the topic
in the parameter ``stream``. See doc/point_clouds.md for all topics and parameters.
"""

from __future__ import annotations

import secrets
import threading
import time
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from sensor_msgs.msg import CompressedImage, PointCloud2
from std_msgs.msg import UInt64MultiArray

from image_transport_h264.budget import Budget
from image_transport_h264.cdr import CdrError
from image_transport_h264.lazy import IMAGE_QOS, LazyNode, run, STREAM_QOS, Tap
from image_transport_h264.message import compressed
from point_cloud_stream import message
from point_cloud_stream.cloud import CloudError
from point_cloud_stream.codec import encode, FORMAT
from point_cloud_stream.control import Control, GIVE_UP
from point_cloud_stream.parts import FEEDBACK, split

PARAMETERS: dict[str, Any] = {'stream': '', 'topic': '', 'resolution': 0.001, 'lossless': False,
                              'max_rate': 0.0, 'drop_fields': ''}


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
        self._stream, self._cloud, self._part = secrets.randbits(32), 0, 0
        #: Guards the control; notified when a part may be sent.
        self._news = threading.Condition()
        self._known = 0
        self._worker = self.start_worker('encode', self._send)
        self._clouds = Tap(self, PointCloud2, topic, IMAGE_QOS, self._take)
        self._publisher = self.offer(CompressedImage, stream, STREAM_QOS, self._matched)
        self._budget = Budget(self, stream, lambda: self.subscribers(self._publisher))
        self.create_subscription(
            UInt64MultiArray, f'{stream}/{FEEDBACK}', self._heard, STREAM_QOS)
        self._matched()
        self.get_logger().info(f'{topic} goes out as {stream}')

    # --- in the executor's thread

    def _matched(self) -> None:
        subscribers = self.subscribers(self._publisher)
        if subscribers < self._known:
            # the receiver that has gone would acknowledge no more
            with self._news:
                self._control.forget()
                self._news.notify_all()
        self._known = subscribers
        self._clouds.want(subscribers > 0)

    def _take(self, cloud: bytes) -> None:
        with self._news:
            due = self._control.arrived(time.monotonic())
        if due:
            self._worker.put(cloud)

    def _heard(self, feedback: UInt64MultiArray) -> None:
        if len(feedback.data) != 3 or feedback.data[0] != self._stream:
            return
        _, receiver, number = feedback.data
        with self._news:
            self._control.acknowledged(receiver, min(number, self._part), time.monotonic())
            self._news.notify_all()

    # --- in the worker's thread

    def _send(self, cloud: bytes) -> None:
        """Encode and publish a cloud, part by part as share and link take them."""
        try:
            header, layout, points = message.cloud(cloud)
            coded = encode(layout, points, self._control.resolution, self._drop)
        except (CdrError, CloudError) as error:
            self.complain(str(error), f'cloud of {self._named} not sent: {error}')
            return
        parts = split(coded.data, self._stream, self._cloud, self._part + 1)
        self._cloud = (self._cloud + 1) & 0xffffffff
        with self._news:
            self._control.sending(self._part + len(parts), coded, time.monotonic())
        for part in parts:
            self._budget.pace()
            with self._news:
                if not self._news.wait_for(self._control.may_send, GIVE_UP):
                    self._control.give_up(time.monotonic())
                    return
                self._part += 1
                self._control.sent(self._part, time.monotonic())
            self._budget.sent(len(part), 8.0 * len(coded.data), self._control.latency,
                              short=self._control.resolution > self._control.asked)
            self.put_out(self._publisher, compressed(header, FORMAT, part))


def main() -> None:
    """Run the node until a signal."""
    run(EncoderNode)
