# SPDX-License-Identifier: Apache-2.0
"""Share the base of both nodes: work only for subscribers, log each cause once."""

from __future__ import annotations

from collections.abc import Callable
import threading
from typing import Any, Optional

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from image_transport_h264 import ending
from image_transport_h264.acknowledgement import wait_for_all_acked
from image_transport_h264.worker import Worker


def _qos(
    depth: int, reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability,
                      durability=DurabilityPolicy.VOLATILE)


#: Packets of a stream; reliable for recorders and other subscribers that ask for it.
STREAM_QOS = _qos(8)
#: Slices of images, and their acknowledgements; there are fewer at once, see ``slices.py``.
SLICES_QOS = _qos(64)
#: Images: the newest ones.
IMAGE_QOS = _qos(2)
#: Messages that are useless if they are late: acknowledgements, and pieces of packets.
FEEDBACK_QOS = _qos(8, ReliabilityPolicy.BEST_EFFORT)
PIECES_QOS = _qos(128, ReliabilityPolicy.BEST_EFFORT)
REQUEST_QOS = _qos(1)
#: A message that later subscribers receive too.
LATCHED_QOS = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

#: Maximum number of causes that a node logs; some have a text of the message.
MOST_CAUSES = 64
#: Time-out of a message's acknowledgement in seconds; a reader that hangs delays the others.
LONGEST = 2.0


def best_effort(qos: QoSProfile) -> QoSProfile:
    """Return the profile with best-effort reliability."""
    return _qos(qos.depth, ReliabilityPolicy.BEST_EFFORT)


def printable(text: str) -> str:
    """Return a text of another computer without what controls a terminal."""
    return ''.join(c if c.isprintable() else '?' for c in text)


def every(
    node: Node, seconds: float, call: Callable[[], None], *, autostart: bool = True,
) -> Timer:
    """
    Call a function of a node periodically, also while the system clock is set back.

    A timer of the node's own clock would stop for as long, and under ``use_sim_time`` wait for
    ``/clock``.
    """
    return node.create_timer(
        seconds, call, clock=Clock(clock_type=ClockType.STEADY_TIME), autostart=autostart)


def run(kind: Callable[[], LazyNode]) -> None:
    """Run a node until a signal; exit with status 1 if its worker failed."""
    node = ending.run(kind)
    if node is not None and node.failed:
        raise SystemExit(1)


class LazyNode(Node):
    """A node that subscribes only while its topics have subscribers."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._complained: set[str] = set()
        self._complaining = threading.Lock()
        self._counts: dict[Publisher, int] = {}
        self._workers: list[Worker[Any]] = []
        self.failed = False

    def start_worker(
        self, name: str, work: Callable[[Any], None], waiting: int = 1,
    ) -> Worker[Any]:
        """Start a worker thread, which shuts the process down if it fails; see ``Worker``."""
        self._workers.append(Worker(name, work, self.fail, waiting))
        return self._workers[-1]

    def destroy_node(self) -> None:
        """Stop the workers, then destroy the node."""
        for worker in self._workers:
            worker.stop()
        super().destroy_node()

    def fail(self) -> None:
        """Shut the process down, so that the launch can restart the node."""
        self.failed = True
        rclpy.try_shutdown(context=self.context)

    def put_out(self, publisher: Publisher, message: Any) -> None:
        """Publish a message; drop it if a slow subscriber leaves the middleware no room."""
        try:
            publisher.publish(message)
        except RuntimeError as error:  # RCLError of rclpy
            if not rclpy.ok(context=self.context):
                return
            self.complain('slow subscriber', f'not published on {publisher.topic_name}: {error}')

    def all_acknowledged(self, publisher: Publisher) -> bool:
        """Wait until reliable readers have all messages; return False after a time-out."""
        try:
            return wait_for_all_acked(publisher, LONGEST)
        except RuntimeError:
            if rclpy.ok(context=self.context):
                raise
            return False  # the node is shutting down

    def subscribers(self, publisher: Publisher) -> int:
        """
        Return the number of subscribers of a publisher that ``offer`` created, in any thread.

        ROS 2's own count is not asked: with Cyclone DDS, that discards an event which is not
        handled yet, and ``changed`` would not be called.
        """
        return self._counts[publisher]

    def complain(self, cause: str, message: str) -> None:
        """
        Log a warning for the first message of each cause.

        :param message: may have texts of other computers, which must control no terminal.
        """
        with self._complaining:
            if cause in self._complained or len(self._complained) >= MOST_CAUSES:
                return
            self._complained.add(cause)
        self.get_logger().warning(
            f'{printable(message)} (further ones of this kind go unmentioned)')

    def offer(
        self, kind: Any, topic: str, qos: QoSProfile, changed: Callable[[], None],
    ) -> Publisher:
        """Create a publisher; ``changed`` is called when subscribers come or go."""
        def matched(event: Any) -> None:
            self._counts[publisher] = event.current_count
            changed()

        publisher = self.create_publisher(
            kind, topic, qos, event_callbacks=PublisherEventCallbacks(matched=matched))
        self._counts[publisher] = 0
        return publisher


def fitting(node: Node, topic: str, qos: QoSProfile) -> QoSProfile:
    """Return the profile, with best effort unless all publishers of the topic are reliable."""
    kinds = [info.qos_profile.reliability for info in node.get_publishers_info_by_topic(topic)]
    if kinds and all(kind == ReliabilityPolicy.RELIABLE for kind in kinds):
        return qos
    return best_effort(qos)


class Tap:
    """
    A subscription to serialized messages that exists only on request.

    The tap subscribes again if a new publisher needs another reliability.
    """

    def __init__(
        self, node: Node, kind: Any, topic: str, qos: QoSProfile,
        heard: Callable[[bytes], None], *, adapt: bool = True,
    ) -> None:
        self._node, self._kind, self._topic = node, kind, topic
        self._qos, self._heard, self._adapt = qos, heard, adapt
        self._subscription: Optional[Subscription] = None
        self._reliability: Optional[ReliabilityPolicy] = None

    def want(self, wanted: bool) -> None:
        """Subscribe or unsubscribe; call this in the executor's thread."""
        if wanted and self._subscription is None:
            self._subscribe()
        elif not wanted and self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def ask_for(self, qos: QoSProfile) -> None:
        """Change the profile of the subscription; call this in the executor's thread."""
        if self._subscription is None or qos.reliability == self._qos.reliability:
            return
        # Subscribe before unsubscribing, so that no message is missed; some arrive twice.
        self._qos, old = qos, self._subscription
        self._subscribe()
        self._node.destroy_subscription(old)

    def _subscribe(self) -> None:
        qos = fitting(self._node, self._topic, self._qos) if self._adapt else self._qos
        self._reliability = qos.reliability
        events = SubscriptionEventCallbacks(matched=self._matched if self._adapt else None)
        self._subscription = self._node.create_subscription(
            self._kind, self._topic, self._heard, qos, event_callbacks=events, raw=True)

    def _matched(self, _: Any) -> None:
        reliability = fitting(self._node, self._topic, self._qos).reliability
        if self._subscription is not None and reliability != self._reliability:
            self.want(False)
            self._subscribe()


class Relay:
    """Forward messages from a topic to another while the other one has subscribers."""

    def __init__(
        self, node: LazyNode, kind: Any, source: str, target: str, qos: QoSProfile,
    ) -> None:
        self._node = node
        self._publisher = node.offer(kind, target, qos, self._changed)
        self._tap = Tap(node, kind, source, qos, self._publisher.publish)

    def _changed(self) -> None:
        self._tap.want(self._node.subscribers(self._publisher) > 0)
