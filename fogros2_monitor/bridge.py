# SPDX-License-Identifier: Apache-2.0
"""
Serve a machine's topics, services and parameters to Foxglove, and publish viewers' messages.

The node subscribes to a topic only while a viewer shows it, and forwards messages without
decoding them. A slow viewer loses its oldest messages, without effect on other viewers. An H.264
stream of ``image_transport_h264`` is sent as ``foxglove_msgs/CompressedVideo``.

Parameters: ``address``, ``port`` (0: any free port; the log has the port), ``topics`` (patterns of
the names of topics, services and parameters to show), ``client_publish`` (whether viewers may
publish, call services and set parameters) and ``gate`` (a file descriptor that ends with the gate,
without which nobody reaches the bridge; then the bridge fails).

Protocol: https://github.com/foxglove/ws-protocol, implemented by ``foxglove-sdk``.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
import os
import threading
from typing import Optional

import foxglove
from foxglove import MessageSchema, Parameter, Schema, Service, ServiceSchema
from foxglove.websocket import Capability, ChannelView, Client, ClientChannel, ServerListener
from rcl_interfaces.msg import ParameterEvent
import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.executors import SingleThreadedExecutor
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile

from fogros2 import ros_types
from fogros2.ros_names import absolute
from fogros2.untrusted import clean
from fogros2_monitor import assets
from fogros2_monitor.definitions import definition
from fogros2_monitor.parameters import Parameters, shown
from fogros2_monitor.services import Services
from fogros2_monitor.topics import GraphNode, LOOK, Topic
from image_transport_h264 import ending
from image_transport_h264.lazy import every

#: Number of messages to keep for a slow viewer.
BACKLOG = 64
#: Types of the services by which nodes show their parameters and types; viewers need none.
_NODES = ('rcl_interfaces/', 'type_description_interfaces/')
#: Number of viewers that may wait for parameters at once. The SDK waits in a thread that serves
#: viewers, and gets twice as many.
WAITING = 4


class BridgeNode(GraphNode, ServerListener):
    """The node that serves the topics of the graph."""

    def __init__(self) -> None:
        super().__init__('fogros2_bridge')
        #: Runs the requests of viewers, which arrive in threads of the SDK.
        self._work = SingleThreadedExecutor()
        self._work.add_node(self)
        self._published: dict[tuple[int, int], Publisher] = {}
        address = str(self.declare_parameter('address', '127.0.0.1').value)
        port = int(self.declare_parameter('port', 8765).value)
        self._patterns = list(self.declare_parameter('topics', ['*']).value)
        self._publish = bool(self.declare_parameter('client_publish', True).value)
        self._offered: dict[str, str] = {}
        self._service_calls = Services(self)
        self._node_parameters = Parameters(self._service_calls, self._shows, self.refuse)
        self._free = threading.Semaphore(WAITING)
        self._server = foxglove.start_server(
            name=self.get_name(), host=address, port=port, server_listener=self,
            capabilities=[Capability.Parameters, *(
                [Capability.ClientPublish, Capability.Services] if self._publish else [])],
            supported_encodings=['cdr'], asset_handler=assets.read, context=self.viewers,
            message_backlog_size=BACKLOG)
        self.failed = False
        gate = int(self.declare_parameter('gate', -1).value)
        self._look()
        self.create_subscription(ParameterEvent, '/parameter_events', self._tell_change, 1000)
        every(self, LOOK, self._look)
        self.get_logger().info(f'serving ws://{address}:{self._server.port}')
        if gate >= 0:
            threading.Thread(target=self._follow, args=(gate,), name='gate', daemon=True).start()

    def destroy_node(self) -> None:
        """Disconnect the viewers, then destroy the node."""
        self._service_calls.close()
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

    def on_get_parameters(self, client: Client, param_names: list[str],
                          request_id: Optional[str] = None) -> list[Parameter]:
        """Return the parameters of nodes."""
        return self._with_parameters(param_names, [])

    def on_set_parameters(self, client: Client, parameters: list[Parameter],
                          request_id: Optional[str] = None) -> list[Parameter]:
        """Set parameters of nodes; return their values."""
        if self._publish and parameters:
            return self._with_parameters([each.name for each in parameters], parameters)
        self.refuse('this bridge sets no parameters')
        return []

    def _with_parameters(self, names: list[str], changes: list[Parameter]) -> list[Parameter]:
        if not self._free.acquire(blocking=False):
            self.refuse(f'{WAITING} viewers wait for parameters')
            return []
        # this thread of the SDK waits; a message, even about nothing, wakes one for other viewers
        self._work.create_task(lambda: self._server.remove_status(['']))
        try:
            nodes = {name.rpartition('/')[0] for name in ros_types.services(self)
                     if name.endswith('/list_parameters') and '/_' not in name
                     and self._served(name)} - {self.get_fully_qualified_name()}
            if changes:
                self._node_parameters.set(changes, nodes)
            return shown(self._node_parameters.get(names, nodes))
        finally:
            self._free.release()

    # -- in the executor's thread ---------------------------------------------------------------

    def _with_topic(self, channel: int, action: Callable[[Topic], None]) -> None:
        def act() -> None:
            for topic in self._topics.values():
                if topic.id == channel:
                    action(topic)

        self._work.create_task(act)

    def _with_publisher(self, client: Client, channel: int,
                        action: Callable[[tuple[int, int]], None]) -> None:
        key = client.id, channel
        self._work.create_task(lambda: action(key) if key in self._published else None)

    def _look(self) -> None:
        """Offer new topics and services; remove those that are gone."""
        super()._look()
        kinds = {name: kind for name, kind in ros_types.services(self).items() if self._publish
                 and kind not in self._unknown and not kind.startswith(_NODES)
                 and self._shows(name) and self._served(name)}
        gone = [name for name, kind in self._offered.items() if kinds.get(name) != kind]
        self._service_calls.prune(lambda name: name not in gone and self._served(name))
        self._server.remove_services(gone)
        self._offered = {name: kinds[name] for name in self._offered if name not in gone}
        for name in kinds.keys() - self._offered.keys():
            try:
                self._server.add_services([self._service(name, kinds[name])])
                self._offered[name] = kinds[name]
            except LookupError as error:
                self._unknown.add(kinds[name])
                self.get_logger().warning(f'service {name} is not shown: {error}')

    def _served(self, name: str) -> bool:
        # clients alone make a service appear in the graph
        return int(self.count_services(name)) > 0

    def _tell_change(self, event: ParameterEvent) -> None:
        """Send changes of parameters to the viewers that subscribed to them."""
        self._server.publish_parameter_values(shown({
            name: each.value for each in (*event.new_parameters, *event.changed_parameters)
            if self._shows(name := f'{event.node}.{each.name}')}))

    def _service(self, name: str, kind: str) -> Service:
        """
        Return a service as viewers see it.

        :raises LookupError: its type is not installed here.
        """
        cls = ros_types.service(kind)
        request, response = (MessageSchema(encoding='cdr', schema=Schema(
            name=f'{kind}_{end}', encoding='ros2msg',
            data=definition(f'{kind}_{end}', getattr(cls, end)).encode()))
            for end in ('Request', 'Response'))
        return Service(name, schema=ServiceSchema(kind, request=request, response=response),
                       handler=functools.partial(self._service_calls.answer, cls))

    def _unadvertise(self, key: tuple[int, int]) -> None:
        self.destroy_publisher(self._published.pop(key))

    def _advertise(self, key: tuple[int, int], topic: str, encoding: str, kind: str) -> None:
        """Create a publisher for a viewer; report to all viewers if that is impossible."""
        if encoding != 'cdr':
            self.refuse(f"{topic}: publishes '{encoding}', this bridge takes cdr")
            return
        if not self._shows(absolute(topic, '/')):
            self.refuse(f'{topic}: not among the topics of this bridge')
            return
        try:
            # every subscriber takes it, those of latched topics, too
            qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._published[key] = self.create_publisher(ros_types.message(kind), topic, qos)
        except (LookupError, NameValidationException) as error:
            self.refuse(f'{topic}: {error}')

    def _follow(self, gate: int) -> None:
        os.read(gate, 1)
        if rclpy.ok():
            self.failed = True
            self.get_logger().error('the gate has ended, so nobody reaches this bridge')
            rclpy.try_shutdown()

    def refuse(self, why: str) -> None:
        """Report to the log and to all viewers."""
        why = clean(why[:1000])
        self.get_logger().warning(why)
        self._server.publish_status(why, foxglove.StatusLevel.Warning)


def main() -> None:
    """Run the bridge until a signal."""
    os.environ['TOKIO_WORKER_THREADS'] = str(2 * WAITING)  # read by the SDK
    # an error may be another type of a topic with Fast DDS
    bridge = ending.run(BridgeNode, BridgeNode.refuse)
    if bridge is not None and bridge.failed:
        raise SystemExit(1)


if __name__ == '__main__':
    main()
