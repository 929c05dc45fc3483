# SPDX-License-Identifier: Apache-2.0
"""
Serve a machine's topics to Foxglove, and publish the messages of viewers.

The node subscribes to a topic only while a viewer shows it, and forwards messages without
decoding them. A slow viewer loses its oldest messages, without effect on other viewers. An H.264
stream of ``image_transport_h264`` is sent as ``foxglove.CompressedVideo``.

Parameters: ``address``, ``port`` (0: any free port; the log has the port), ``topics`` (patterns of
topics to show), ``client_publish`` (whether viewers may publish) and ``backlog`` (number of
messages to keep for a slow viewer).

Protocol: https://github.com/foxglove/ws-protocol, implemented by ``foxglove-sdk``.
"""

from __future__ import annotations

from collections.abc import Callable
import fnmatch
import functools
from typing import Any, Optional

import foxglove
from foxglove.messages import CompressedVideo, Timestamp
from foxglove.websocket import Capability, ChannelView, Client, ClientChannel, ServerListener
import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import Empty

from fogros2 import ros_types
from fogros2_monitor.definitions import definition
from image_transport_h264 import memory
from image_transport_h264.cdr import CdrError
from image_transport_h264.message import coded

#: Poll interval of the topics in the graph, in seconds.
LOOK = 0.5
#: Number of messages to keep for a slow viewer.
BACKLOG = 64
_COMPRESSED = 'sensor_msgs/msg/CompressedImage'
#: Suffix of the topic that requests a keyframe of an H.264 stream.
_KEYFRAME = '/keyframe'


class _Topic:
    """A topic as viewers see it, with a subscription while a viewer shows it."""

    def __init__(self, node: BridgeNode, name: str, kind: str, video: bool) -> None:
        self.kind = kind
        self.video = video
        self.viewers: set[int] = set()
        self._node = node
        self._name = name
        self._class = ros_types.message(kind)
        schema = CompressedVideo.get_schema() if video else foxglove.Schema(
            name=kind, encoding='ros2msg', data=definition(kind).encode())
        self._channel = foxglove.Channel(
            name, schema=schema, message_encoding='protobuf' if video else 'cdr',
            context=node.viewers)
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
        self._channel.log(CompressedVideo(
            timestamp=Timestamp(header.sec, header.nanosec), frame_id=header.frame_id,
            data=bytes(data), format=form).encode())


class BridgeNode(Node, ServerListener):
    """
    The node that serves the topics of the graph.

    :param executor: runs the requests of viewers, which arrive in threads of the SDK.
    """

    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__('fogros2_bridge')
        self.viewers = foxglove.Context()
        self._work = executor
        self._topics: dict[str, _Topic] = {}
        self._published: dict[tuple[int, int], Publisher] = {}
        self._unknown: set[str] = set()
        address = str(self.declare_parameter('address', '127.0.0.1').value)
        port = int(self.declare_parameter('port', 8765).value)
        self._patterns = list(self.declare_parameter('topics', ['*']).value)
        publish = bool(self.declare_parameter('client_publish', True).value)
        backlog = int(self.declare_parameter('backlog', BACKLOG).value)
        self._look()
        self._server = foxglove.start_server(
            name=self.get_name(), host=address, port=port, server_listener=self,
            capabilities=[Capability.ClientPublish] if publish else [],
            supported_encodings=['cdr'], context=self.viewers, message_backlog_size=backlog)
        self.create_timer(LOOK, self._look)
        self.get_logger().info(f'serving ws://{address}:{self._server.port}')

    def destroy_node(self) -> None:
        """Disconnect the viewers, then destroy the node."""
        self._server.stop()
        super().destroy_node()

    # -- requests of viewers, from the SDK's threads --------------------------------------------

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Start to send a topic to a viewer."""
        self._with_topic(channel.id, lambda topic: topic.look(client.id))

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Stop sending a topic to a viewer."""
        self._with_topic(channel.id, lambda topic: topic.look_away(client.id))

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        """Create a publisher for a viewer."""
        self._work.create_task(functools.partial(
            self._advertise, (client.id, channel.id), channel.topic, channel.encoding,
            channel.schema_name))

    def on_client_unadvertise(self, client: Client, client_channel_id: int) -> None:
        """Destroy a viewer's publisher."""
        self._with_publisher(client, client_channel_id, self._unadvertise)

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        """Publish a viewer's message."""
        self._with_publisher(client, client_channel_id,
                             lambda key: self._published[key].publish(data))

    # -- in the executor's thread ---------------------------------------------------------------

    def _with_topic(self, channel: int, action: Callable[[_Topic], None]) -> None:
        def act() -> None:
            for topic in self._topics.values():
                if topic.id == channel:
                    action(topic)
                    break

        self._work.create_task(act)

    def _with_publisher(
        self, client: Client, channel: int, action: Callable[[tuple[int, int]], None],
    ) -> None:
        key = client.id, channel
        self._work.create_task(lambda: action(key) if key in self._published else None)

    def _unadvertise(self, key: tuple[int, int]) -> None:
        self.destroy_publisher(self._published.pop(key))

    def _advertise(self, key: tuple[int, int], topic: str, encoding: str, kind: str) -> None:
        """Create a publisher for a viewer; report to all viewers if that is impossible."""
        if encoding != 'cdr':
            self._refuse(f"{topic}: publishes '{encoding}', this bridge takes cdr")
            return
        try:
            self._published[key] = self.create_publisher(ros_types.message(kind), topic, 10)
        except (LookupError, NameValidationException) as error:
            self._refuse(f'{topic}: {error}')

    def _refuse(self, why: str) -> None:
        self.get_logger().warning(why)
        self._server.publish_status(why, foxglove.StatusLevel.Warning)

    def _look(self) -> None:
        """Add new topics and remove topics that are gone."""
        kinds = {name: kind for name, kind in ros_types.topics(self).items()
                 if '/_' not in name  # hidden by ROS 2's naming convention
                 and any(fnmatch.fnmatchcase(name, pattern) for pattern in self._patterns)}
        for name in self._topics.keys() - kinds.keys():
            self._topics.pop(name).close()
        for name, kind in kinds.items():
            topic = self._topics.get(name)
            video = kind == _COMPRESSED and f'{name}{_KEYFRAME}' in kinds
            if topic is not None and (topic.kind, topic.video) == (kind, video):
                topic.refit()
                continue
            if kind in self._unknown:
                continue
            if topic is not None:
                self._topics.pop(name).close()
            try:
                self._topics[name] = _Topic(self, name, kind, video)
            except LookupError as error:
                self._unknown.add(kind)
                self.get_logger().warning(f'{name} is not shown: {error}')


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


def main() -> None:
    """Run the bridge until a signal."""
    memory.keep()
    rclpy.init()
    executor = SingleThreadedExecutor()
    node = BridgeNode(executor)
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()


if __name__ == '__main__':
    main()
