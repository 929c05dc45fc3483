# SPDX-License-Identifier: Apache-2.0
"""What both nodes have: work only while somebody listens, and one log line per cause."""

from __future__ import annotations

from collections.abc import Callable
import threading
from typing import Any, Optional

import rclpy
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from image_transport_h264.turns import Turns

#: A stream's packets: for recorders and others who ask for it, those the network lost come again.
STREAM_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=8, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE)
#: Pictures: the newest.
IMAGE_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=2, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE)
#: What is of no use late.
FEEDBACK_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=8, reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE)
#: Pieces of packets: late ones are of no use to their reader.
PIECES_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=128, reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE)
REQUEST_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE)


#: Seconds that a message's acknowledgement is waited for: a reader that hangs delays the others.
LONGEST = 2.0


def best_effort(qos: QoSProfile) -> QoSProfile:
    """Return the profile without repetition of what was lost."""
    return QoSProfile(
        history=qos.history, depth=qos.depth, durability=qos.durability,
        reliability=ReliabilityPolicy.BEST_EFFORT)


class LazyNode(Node):
    """A node that subscribes while it is subscribed to."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._complained: set[str] = set()
        self._complaining = threading.Lock()
        self._turns = Turns()
        self.failed = False

    def destroy_node(self) -> None:
        """End the node, whose worker has ended."""
        self._turns.close()
        super().destroy_node()

    def fail(self) -> None:
        """End the process: a node that can't do its work is to be started anew."""
        self.failed = True
        rclpy.try_shutdown(context=self.context)

    def put_out(self, publisher: Publisher, message: Any) -> None:
        """Publish, unless a subscriber is so slow that the middleware has no room for more."""
        try:
            publisher.publish(message)
        except RuntimeError as error:  # RCLError, in rclpy's words
            if not rclpy.ok(context=self.context):
                return
            self.complain('slow subscriber', f'not published on {publisher.topic_name}: {error}')

    def put_through(self, publisher: Publisher, message: Any) -> None:
        """
        Publish a large message when it is this node's turn, and wait until its readers have it.

        Large images in quick succession leave a slow link no room for what it lost of them: none
        would ever be whole. What comes meanwhile is left out, but for the newest.
        """
        with self._turns.taken(LONGEST):
            self.put_out(publisher, message)
            self.all_acknowledged(publisher)

    def all_acknowledged(self, publisher: Publisher) -> bool:
        """Wait until reliable readers have all that was published; False if that takes long."""
        try:
            return bool(publisher.wait_for_all_acked(Duration(seconds=LONGEST)))
        except RuntimeError:  # RCLError, in rclpy's words
            if rclpy.ok(context=self.context):
                raise
            return False  # the node ends

    def complain(self, cause: str, message: str) -> None:
        """Warn of a cause, the first time it comes up."""
        with self._complaining:
            if cause in self._complained:
                return
            self._complained.add(cause)
        self.get_logger().warning(f'{message} (further ones of this kind go unmentioned)')

    def offer(
        self, kind: Any, topic: str, qos: QoSProfile, changed: Callable[[], None],
    ) -> Publisher:
        """Return a publisher; ``changed`` is called when subscribers come or go."""
        return self.create_publisher(
            kind, topic, qos,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: changed()))

    def fitting(self, topic: str, qos: QoSProfile) -> QoSProfile:
        """Return the profile, best effort if a publisher of the topic has nothing better."""
        told = [info.qos_profile.reliability for info in self.get_publishers_info_by_topic(topic)]
        if told and all(kind == ReliabilityPolicy.RELIABLE for kind in told):
            return qos
        return best_effort(qos)


class Tap:
    """
    A subscription that exists while it is wanted.

    Made anew if a publisher comes up that would be heard better, or not at all, otherwise.
    """

    def __init__(
        self, node: LazyNode, kind: Any, topic: str, qos: QoSProfile,
        heard: Callable[[Any], object], *, adapt: bool = True,
    ) -> None:
        self._node, self._kind, self._topic = node, kind, topic
        self._qos, self._heard, self._adapt = qos, heard, adapt
        self._subscription: Optional[Subscription] = None
        self._reliability: Optional[ReliabilityPolicy] = None

    @property
    def open(self) -> bool:
        """Whether it is subscribed."""
        return self._subscription is not None

    def want(self, wanted: bool) -> None:
        """Subscribe or end it; in the executor's thread."""
        if wanted and self._subscription is None:
            self._subscribe()
        elif not wanted and self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def ask_for(self, qos: QoSProfile) -> None:
        """Take messages by another profile from now on; in the executor's thread."""
        if self._subscription is None or qos.reliability == self._qos.reliability:
            return
        # first the new one, so that the topic is subscribed to at any time; some come twice
        self._qos, old = qos, self._subscription
        self._subscribe()
        self._node.destroy_subscription(old)

    def _subscribe(self) -> None:
        qos = self._node.fitting(self._topic, self._qos) if self._adapt else self._qos
        self._reliability = qos.reliability
        events = SubscriptionEventCallbacks(matched=self._matched if self._adapt else None)
        self._subscription = self._node.create_subscription(
            self._kind, self._topic, self._heard, qos, event_callbacks=events)

    def _matched(self, _: Any) -> None:
        fitting = self._node.fitting(self._topic, self._qos).reliability
        if self._subscription is not None and fitting != self._reliability:
            self.want(False)
            self._subscribe()


class Relay:
    """Passes messages from a topic to another while the other is subscribed to."""

    def __init__(
        self, node: LazyNode, kind: Any, source: str, target: str, qos: QoSProfile,
    ) -> None:
        self._publisher = node.offer(kind, target, qos, self._changed)
        self._tap = Tap(node, kind, source, qos, self._publisher.publish)

    def _changed(self) -> None:
        self._tap.want(self._publisher.get_subscription_count() > 0)
