# SPDX-License-Identifier: Apache-2.0
"""Publishers."""

from typing import Any

from rclpy._dds import DDSError, Writer
from rclpy._entity import Entity
from rclpy._names import demangle_topic
from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.event_handler import EventHandler, PublisherEventCallbacks
from rclpy.exceptions import RCLError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosidl_embedded import cdr

_NO_LIMIT = Duration(seconds=-1)


class Publisher(Entity):
    """Publishes messages; made by :meth:`.Node.create_publisher`."""

    def __init__(self, publisher_impl: Writer, msg_type: Any, topic: str, qos_profile: QoSProfile,
                 event_callbacks: PublisherEventCallbacks, callback_group: CallbackGroup,
                 context: Context, logger_name: str) -> None:
        super().__init__(publisher_impl)
        self._writer = publisher_impl
        self.msg_type = msg_type
        self.topic = topic
        self.qos_profile = qos_profile
        self._context = context
        self.event_handlers: list[EventHandler] = event_callbacks.create_event_handlers(
            callback_group, publisher_impl, topic, logger_name)

    def publish(self, msg: Any) -> None:
        """
        Publish a message, or bytes that hold a serialized one.

        :raises TypeError: if it is another type's message.
        :raises RCLError: if the context has been shut down.
        """
        self._check_alive()
        if isinstance(msg, self.msg_type):
            data = cdr.serialize(msg)
        elif isinstance(msg, bytes):
            data = bytearray(msg)
        else:
            raise TypeError(f'Expected {self.msg_type}, got {type(msg)}')
        if not self._context.ok():
            raise RCLError("Failed to publish: publisher's context is invalid")
        try:
            self._writer.write(data)
        except DDSError:
            if self._context.ok():
                raise
            raise RCLError("Failed to publish: publisher's context is invalid") from None

    def get_subscription_count(self) -> int:
        """Count the subscriptions it publishes to."""
        self._check_alive()
        return len(self._writer.matched())

    @property
    def topic_name(self) -> str:
        """The expanded and remapped topic."""
        self._check_alive()
        return demangle_topic(self._writer.topic) or self._writer.topic

    def assert_liveliness(self) -> None:
        """Say that it is alive, for liveliness MANUAL_BY_TOPIC."""
        self._check_alive()
        self._writer.assert_liveliness()

    def wait_for_all_acked(self, timeout: Duration = _NO_LIMIT) -> bool:
        """Wait until all reliable subscriptions have all messages; negative: without limit."""
        self._check_alive()
        if self.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT:
            return True
        limit = timeout.nanoseconds
        return self._writer.wait_for_acks(limit if limit >= 0 else 2 ** 63 - 1)
