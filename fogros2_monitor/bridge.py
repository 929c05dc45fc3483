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
import functools

import foxglove
from foxglove.websocket import Capability, ChannelView, Client, ClientChannel, ServerListener
import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.publisher import Publisher

from fogros2 import ros_types
from fogros2_monitor.topics import GraphNode, LOOK, Topic
from image_transport_h264 import memory

#: Number of messages to keep for a slow viewer.
BACKLOG = 64


class BridgeNode(GraphNode, ServerListener):
    """
    The node that serves the topics of the graph.

    :param executor: runs the requests of viewers, which arrive in threads of the SDK.
    """

    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__('fogros2_bridge')
        self._work = executor
        self._published: dict[tuple[int, int], Publisher] = {}
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

    def _with_topic(self, channel: int, action: Callable[[Topic], None]) -> None:
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
