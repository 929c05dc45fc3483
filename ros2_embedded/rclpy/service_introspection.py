# SPDX-License-Identifier: Apache-2.0
"""Requests and responses, published for others to see on ``<service>/_service_event``."""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, TYPE_CHECKING

from rclpy._dds import Writer
from rclpy._entity import Entity
from rclpy._names import REQUEST_PREFIX
from rclpy.clock import Clock
from rclpy.qos import QoSProfile
from rosidl_embedded import cdr

if TYPE_CHECKING:
    from rclpy.node import Node


class ServiceIntrospectionState(IntEnum):
    """What is published: nothing, when, or what."""

    OFF = 0
    METADATA = 1
    CONTENTS = 2


class Introspected(Entity):
    """The base of services and clients: publishes what they send and receive."""

    srv_type: Any
    srv_name: str
    _node: 'Callable[[], Node | None]'
    _events: Writer | None = None
    _clock: Clock
    _state = ServiceIntrospectionState.OFF

    @property
    def service_name(self) -> str:
        """The expanded and remapped name."""
        prefix, _, name = self._reader.topic.partition('/')
        return '/' + name.removesuffix('Request' if prefix == REQUEST_PREFIX else 'Reply')

    def configure_introspection(self, clock: Clock, service_event_qos_profile: QoSProfile,
                                introspection_state: ServiceIntrospectionState) -> None:
        """Say what is published, with times of this clock."""
        if self._events is not None:
            self._ends.remove(self._events)
            self._events.close()
        self._events, self._clock, self._state = None, clock, introspection_state
        node = self._node()
        if introspection_state != ServiceIntrospectionState.OFF and node is not None:
            self._events = node._event_writer(self, service_event_qos_profile)
            self._ends.append(self._events)

    def _tell(self, kind: int, client: bytes, number: int, request: Any = None,
              response: Any = None) -> None:
        if self._events is None:
            return
        from service_msgs.msg import ServiceEventInfo
        event = self.srv_type.Event(info=ServiceEventInfo(
            event_type=kind, stamp=self._clock.now().to_msg(),
            client_gid=list(client.ljust(16, b'\0')), sequence_number=number))
        if self._state == ServiceIntrospectionState.CONTENTS:
            event.request = [] if request is None else [request]
            event.response = [] if response is None else [response]
        self._events.write(cdr.serialize(event))
