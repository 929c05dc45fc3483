# SPDX-License-Identifier: Apache-2.0
"""
Pass messages of the ROS graph on to viewers or a file, without decoding them.

An H.264 stream of ``image_transport_h264`` is passed on as ``foxglove_msgs/CompressedVideo``, as
rosbag2 opens no file whose topics are serialized in different ways.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import fnmatch
import json
from typing import Any, Optional

import foxglove
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import Empty

from fogros2 import ros_types
from fogros2_monitor.definitions import definition, VIDEO
from image_transport_h264.cdr import CdrError, Writer
from image_transport_h264.message import coded

#: Poll interval of the topics in the graph, in seconds.
LOOK = 0.5
_COMPRESSED = 'sensor_msgs/msg/CompressedImage'
#: Suffix of the topic that requests a keyframe of an H.264 stream.
_KEYFRAME = '/keyframe'


class Topic:
    """A topic as viewers see it, with a subscription while a viewer shows it."""

    def __init__(self, node: GraphNode, name: str, kind: str, video: bool) -> None:
        self.kind = kind
        self.video = video
        self.viewers: set[int] = set()
        self._node = node
        self._name = name
        self._class = ros_types.message(kind)
        shown, text = VIDEO if video else (kind, definition(kind))
        self._channel = foxglove.Channel(
            name, schema=foxglove.Schema(name=shown, encoding='ros2msg', data=text.encode()),
            message_encoding='cdr', context=node.viewers,
            metadata={'offered_qos_profiles': offered(node, name)})
        self._subscription: Optional[Subscription] = None
        self._fits: tuple[Any, Any] = (None, None)
        self._requests: Optional[Publisher] = None
        if video:
            self._requests = node.create_publisher(Empty, f'{name}{_KEYFRAME}', 1)

    @property
    def id(self) -> int:
        """Return the id of the topic's channel."""
        return self._channel.id()

    def look(self, viewer: int) -> None:
        """Send the topic to a viewer from now on, latched messages included."""
        self.viewers.add(viewer)
        if self._requests is not None:
            self._requests.publish(Empty())
        if self._subscription is not None and self._fits[0] == DurabilityPolicy.TRANSIENT_LOCAL:
            # Only a new subscription receives latched messages again. The other viewers receive
            # them twice, which does no harm for a latched topic.
            self._unsubscribe()
        if self._subscription is None:
            self._subscribe()

    def look_away(self, viewer: int) -> None:
        """Stop sending to a viewer; unsubscribe with the last viewer."""
        self.viewers.discard(viewer)
        if not self.viewers:
            self._unsubscribe()

    def refit(self) -> None:
        """Subscribe again if new publishers need another QoS profile."""
        if self._subscription is not None and self._node.get_publishers_info_by_topic(self._name):
            qos = fitting(self._node, self._name)
            if (qos.durability, qos.reliability) != self._fits:
                self._unsubscribe()
                self._subscribe()

    def close(self) -> None:
        """Remove the topic from the viewers' lists."""
        self._unsubscribe()
        if self._requests is not None:
            self._node.destroy_publisher(self._requests)
        self._channel.close()

    def _subscribe(self) -> None:
        qos = fitting(self._node, self._name)
        self._fits = qos.durability, qos.reliability
        self._subscription = self._node.create_subscription(
            self._class, self._name, self._show_video if self.video else self._channel.log, qos,
            raw=True)

    def _unsubscribe(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _show_video(self, message: bytes) -> None:
        try:
            header, form, data = coded(message)
        except CdrError as error:
            self._node.get_logger().warning(f'{self._name}: {error}', once=True)
            return
        self._channel.log(Writer().header(header).octets(data).string(form).data())


class GraphNode(Node):
    """
    A node that has topics of the graph, by default those whose names match patterns.

    :ivar viewers: where the topics' messages go.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.viewers = foxglove.Context()
        self._topics: dict[str, Topic] = {}
        self._unknown: set[str] = set()
        self._patterns: Sequence[str] = ()

    def _look(self) -> None:
        """Add new topics and remove topics that are gone."""
        everything = ros_types.topics(self)
        names = self._chosen(everything)
        kinds = {name: everything[full] for name, full in names.items()}
        for name in self._topics.keys() - kinds.keys():
            self._topics.pop(name).close()
        for name, kind in kinds.items():
            topic = self._topics.get(name)
            video = kind == _COMPRESSED and f'{names[name]}{_KEYFRAME}' in everything
            if topic is not None and (topic.kind, topic.video) == (kind, video):
                topic.refit()
                continue
            if kind in self._unknown:
                continue
            if topic is not None:
                self._topics.pop(name).close()
            try:
                self._topics[name] = self._added(Topic(self, name, kind, video))
            except LookupError as error:
                self._unknown.add(kind)
                self.get_logger().warning(f'{name} is not shown: {error}')

    def _chosen(self, everything: Iterable[str]) -> dict[str, str]:
        """Return the names of topics to show, with the names that the graph has for them."""
        return {name: name for name in everything if self._shows(name)}

    def _shows(self, name: str) -> bool:
        return '/_' not in name and any(  # hidden by ROS 2's naming convention
            fnmatch.fnmatchcase(name, pattern) for pattern in self._patterns)

    def _added(self, topic: Topic) -> Topic:
        """Note a new topic; return it."""
        return topic


def fitting(node: Node, topic: str) -> QoSProfile:
    """Return the strictest QoS profile that is compatible with all publishers of a topic."""
    offered = [info.qos_profile for info in node.get_publishers_info_by_topic(topic)]
    reliable = bool(offered) and all(
        qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = bool(offered) and all(
        qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    depth = sum(qos.depth for qos in offered) if latched else 0
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=max(10, min(depth, 1000)),
        reliability=(ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT),
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE))


def offered(node: Node, topic: str) -> str:
    """Return the QoS profiles of a topic's publishers, as rosbag2 writes and reads them: YAML."""
    def profile(qos: QoSProfile) -> dict[str, Any]:
        times = {name: dict(zip(('sec', 'nsec'), divmod(getattr(qos, name).nanoseconds, 10 ** 9)))
                 for name in ('deadline', 'lifespan', 'liveliness_lease_duration')}
        policies = {name: getattr(qos, name).short_key
                    for name in ('history', 'reliability', 'durability', 'liveliness')}
        return {**policies, 'depth': qos.depth, **times, 'avoid_ros_namespace_conventions': False}

    return json.dumps([profile(info.qos_profile)
                       for info in node.get_publishers_info_by_topic(topic)])
