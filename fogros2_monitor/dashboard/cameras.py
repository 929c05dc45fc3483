# SPDX-License-Identifier: Apache-2.0
"""Take pictures of streamed topics at intervals, at a low cost."""

from __future__ import annotations

import base64
from collections.abc import Callable
import time
from typing import Any, Optional

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Empty

from fogros2_monitor.dashboard import shots
from image_transport_h264 import stills
from image_transport_h264.cdr import CdrError
from image_transport_h264.codec import CodecError, Decoder, Missing
from image_transport_h264.message import coded, KEY_REQUEST, picture
from image_transport_h264.picture import Picture

#: Seconds between two pictures of an image topic (IMAGE) and of a stream between machines
#: (STREAM), and seconds without a picture after which the camera subscribes again (TIMEOUT).
IMAGE, STREAM, TIMEOUT = 1.0, 5.0, 5.0
#: Seconds by which a picture may be early, and seconds between two requests for a keyframe.
SLACK, REQUEST = 0.25, 0.3
_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=4,
                  reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)

Tell = Callable[[dict[str, Any]], None]


class Camera:
    """
    Take pictures of an image topic: one message per second.

    :param tell: callback for ``{'picture': name, 'number': n, 'data': base64}``; after an error
        the dictionary has ``note`` with the reason instead of number and data.
    :param name: topic of the stream; ``topic`` is the topic to subscribe to.
    """

    interval = IMAGE

    def __init__(self, node: Node, tell: Tell, name: str, topic: str) -> None:
        self._node, self._tell, self._name, self.topic = node, tell, name, topic
        self._subscription: Optional[Subscription] = None
        self._asked = -1e9
        self._number = 0
        self._due = self._stay = False

    def look(self, *, stay: bool = False) -> None:
        """
        Take a picture if the interval is over.

        :param stay: whether to stay subscribed between two pictures.
        """
        self._stay = stay
        now = time.monotonic()
        if self._subscription is not None and now - self._asked > TIMEOUT:
            self.close()  # the publisher of this subscription may be gone
        if now - self._asked > self.interval - SLACK:
            if self._subscription is None:
                self._asked = now
                self._subscription = self._subscribe()
            self._due = True

    def close(self) -> None:
        """Unsubscribe."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def end(self) -> None:
        """Destroy everything that the camera created."""
        self.close()

    def _subscribe(self) -> Subscription:
        return self._node.create_subscription(Image, self.topic, self._take, _QOS, raw=True)

    def _take(self, data: bytes) -> None:
        if self._due:
            try:
                shown = self._picture(data)
                if shown is not None:
                    self._show(shots.jpeg(shown))
            except (CdrError, CodecError, RuntimeError) as error:  # RMWError is a RuntimeError
                self._done()
                self._tell({'picture': self._name, 'note': str(error)})

    def _picture(self, data: bytes) -> Optional[Picture]:
        return picture(data)[1]

    def _show(self, shot: bytes) -> None:
        self._done()
        self._number += 1
        self._tell({'picture': self._name, 'number': self._number,
                    'data': base64.b64encode(shot).decode()})

    def _done(self) -> None:
        self._due, self._asked = False, time.monotonic()
        if not self._stay:
            self.close()


class StreamCamera(Camera):
    """
    Take pictures of a stream that no node on the robot decodes.

    Every five seconds the camera requests a keyframe, so it need not follow the stream.
    """

    interval = STREAM

    def __init__(self, node: Node, tell: Tell, name: str, topic: str) -> None:
        super().__init__(node, tell, name, topic)
        self._requests: Publisher = node.create_publisher(Empty, f'{topic}/{KEY_REQUEST}', 1)
        self._requested = -1e9
        self._decoder = Decoder()

    def end(self) -> None:
        """Destroy everything that the camera created."""
        super().end()
        self._node.destroy_publisher(self._requests)

    def _subscribe(self) -> Subscription:
        self._decoder = Decoder()
        return self._node.create_subscription(
            CompressedImage, self.topic, self._take, _QOS, raw=True)

    def _picture(self, data: bytes) -> Optional[Picture]:
        _, form, packet = coded(data)
        if form not in ('h264', 'ffv1'):
            return stills.decode(form, packet)
        try:
            return self._decoder.decode(packet)
        except Missing:
            now = time.monotonic()
            if now - self._requested > REQUEST:
                self._requested = now
                self._requests.publish(Empty())
            return None
