# SPDX-License-Identifier: Apache-2.0
"""
One end of a link on which topics have a limited rate: the robot's end, or a machine's.

A topic has one name on the robot and another one on the machine, so the middleware does not pass
it. Each end sends what its side publishes under a third name, and publishes here what the other
end sends. Of the messages in a period, the newest is sent; of transforms, the newest of each child
frame, all in one message. A topic crosses only while the other side has a subscriber.
"""

from __future__ import annotations

import abc
import contextlib
import json
import os
import sys
import time
from typing import Any, Optional

import rclpy
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from fogros2 import ros_types
from fogros2_share.node import DEPTH, form_of, LOOK, others, profile
from fogros2_share.wire import Echoes, Form
from image_transport_h264 import ending
from image_transport_h264.lazy import every

#: The type whose messages are limited by child frame.
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
#: Maximum number of child frames in a message.
MOST = 10_000


class Way(abc.ABC):
    """
    One direction of a topic.

    :param source: the topic to subscribe to.
    :param target: the topic to publish.
    """

    def __init__(self, node: Node, source: str, target: str) -> None:
        self.node, self.source, self.target = node, source, target
        self.form: Optional[Form] = None
        self.message: Any = None
        self.publisher: Any = None
        self.subscription: Any = None

    def look(self) -> None:
        """
        Follow type and QoS of the publishers; subscribe while the target has subscribers.

        :raises LookupError: the type is not installed here.
        :raises RuntimeError: the other side has another type.
        """
        node = self.node
        form = form_of(others(node, node.get_publishers_info_by_topic(self.source)))
        if form != self.form:
            message = form and ros_types.message(form.kind)
            self.unsubscribe()
            self.unpublish()
            self.form = None
            self.publisher = form and node.create_publisher(message, self.target, profile(form))
            self.form, self.message = form, message
        if not form or not others(node, node.get_subscriptions_info_by_topic(self.target)):
            self.unsubscribe()
        elif self.subscription is None:
            self.subscription = node.create_subscription(
                self.message, self.source, self.heard, profile(form, DEPTH), raw=True)

    def unsubscribe(self) -> None:
        """End the subscription, if there is one."""
        if self.subscription is not None:
            self.node.destroy_subscription(self.subscription)
            self.subscription = None

    def unpublish(self) -> None:
        """End the publisher, if there is one."""
        if self.publisher is not None:
            self.node.destroy_publisher(self.publisher)
            self.publisher = None

    @abc.abstractmethod
    def heard(self, data: bytes) -> None:
        """Handle a serialized message."""


class Leaving(Way):
    """
    The direction to the other end.

    :param period: seconds from a message to the next one.
    """

    def __init__(self, node: Node, source: str, target: str, period: float) -> None:
        super().__init__(node, source, target)
        #: What came from the other end, and is heard here.
        self.echoes = Echoes()
        #: Hashes of the messages that the other direction's publisher gives to later subscribers.
        self.latched: list[int] = []
        #: What the next message has: transforms by child frame, or one serialized message.
        self._newest: dict[str, Any] = {}
        self._timer = every(node, period, self._send, autostart=False)

    def look(self) -> None:
        """Follow the publishers, and expect the other direction's latched messages anew."""
        before = self.subscription
        super().look()
        if self.form is not None and self.subscription is not before:
            self.echoes.restart(time.monotonic(), self.latched if self.form.kept else ())

    def unsubscribe(self) -> None:
        """End the subscription, and forget its messages."""
        super().unsubscribe()
        self._newest.clear()

    def heard(self, data: bytes) -> None:
        """Keep a message for the end of the period; send it at once if none was sent lately."""
        if self.echoes.heard(time.monotonic(), data):
            return
        if self.form is not None and self.form.kind == TRANSFORMS:
            with contextlib.suppress(RuntimeError):  # the bytes are no transforms
                for one in deserialize_message(data, self.message).transforms:
                    if len(self._newest) < MOST or one.child_frame_id in self._newest:
                        self._newest[one.child_frame_id] = one
        else:
            self._newest[''] = data
        if self._timer.is_canceled():
            self._timer.reset()
            self._send()

    def _send(self) -> None:
        newest = [*self._newest.values()]
        self._newest.clear()
        if not newest:
            self._timer.cancel()
        else:
            self.publisher.publish(newest[0] if isinstance(newest[0], bytes)
                                   else self.message(transforms=newest))


class Coming(Way):
    """
    The direction from the other end.

    :param leaving: the other direction.
    """

    def __init__(self, node: Node, source: str, target: str, leaving: Leaving) -> None:
        super().__init__(node, source, target)
        self._leaving = leaving

    def unpublish(self) -> None:
        """End the publisher, and with it the latched messages."""
        super().unpublish()
        self._leaving.latched.clear()

    def heard(self, data: bytes) -> None:
        """Publish a message, which the other direction then does not send back."""
        if self._leaving.subscription is not None:
            self._leaving.echoes.add(time.monotonic(), data)
        if self.form is not None and self.form.kept:
            self._leaving.latched = [*self._leaving.latched, hash(data)][-self.form.kept:]
        self.publisher.publish(data)


class Limits(Node):
    """
    The node.

    :param topics: for each topic its name here, the names in which it leaves and comes, and the
        seconds from a message to the next one.
    """

    def __init__(self, topics: list[tuple[str, str, str, float]]) -> None:
        super().__init__(f'limits_{os.urandom(4).hex()}', start_parameter_services=False)
        self._ways: list[Way] = []
        for name, out, back, period in topics:
            leaving = Leaving(self, name, out, period)
            self._ways += [leaving, Coming(self, back, name, leaving)]
        self._complaints: set[str] = set()
        every(self, LOOK, self._look)

    def _look(self) -> None:
        for way in self._ways:
            try:
                way.look()
            except (LookupError, RuntimeError) as error:
                if rclpy.ok() and way.source not in self._complaints:
                    self._complaints.add(way.source)
                    self.get_logger().warning(f'{way.source} does not cross: {error}')


def main() -> None:
    """Run until a signal; the first argument is the topics as JSON."""
    ending.run(lambda: Limits(json.loads(sys.argv[1])))
