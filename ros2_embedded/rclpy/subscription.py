# SPDX-License-Identifier: Apache-2.0
"""Subscriptions."""

from collections.abc import Callable
from enum import Enum
from functools import partial
import inspect
import time
from typing import Any

from rclpy._dds import Reader
from rclpy._entity import Entity, Work
from rclpy._names import demangle_topic
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import EventHandler, SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from rosidl_embedded import cdr


class Subscription(Entity):
    """Receives messages; made by :meth:`.Node.create_subscription`."""

    class CallbackType(Enum):
        """Whether the callback wants to know about the message, too."""

        MessageOnly = 0
        WithMessageInfo = 1

    def __init__(self, subscription_impl: Reader, msg_type: Any, topic: str,
                 callback: Callable[..., Any], callback_group: CallbackGroup,
                 qos_profile: QoSProfile, raw: bool,
                 event_callbacks: SubscriptionEventCallbacks, logger_name: str) -> None:
        super().__init__(subscription_impl)
        self._reader = subscription_impl
        self.msg_type = msg_type
        self.topic = topic
        self.callback = callback
        self.callback_group = callback_group
        self.qos_profile = qos_profile
        self.raw = raw
        self._logger_name = logger_name
        self.event_handlers: list[EventHandler] = event_callbacks.create_event_handlers(
            callback_group, subscription_impl, topic, logger_name)

    def _handle(self) -> int | None:
        return None if self._destroyed else self._reader.condition

    def _take(self, executor: Any) -> Work | None:
        parse = bytes if self.raw else partial(cdr.deserialize, cls=self.msg_type)
        sample, message = self._read(parse, f"a message on topic '{self.topic}'")
        if sample is None:
            return None
        if self._callback_type is Subscription.CallbackType.MessageOnly:
            return self._callback, (message,), None
        return self._callback, (message, {
            'source_timestamp': sample.source_timestamp,
            'received_timestamp': time.time_ns(),
            'publication_sequence_number': None,
            'reception_sequence_number': None}), None

    def get_publisher_count(self) -> int:
        """Count the publishers it receives from."""
        self._check_alive()
        return len(self._reader.matched())

    @property
    def topic_name(self) -> str:
        """The expanded and remapped topic."""
        self._check_alive()
        return demangle_topic(self._reader.topic) or self._reader.topic

    @property
    def callback(self) -> Callable[..., Any]:
        """What is called with each message, or with it and what is known of it."""
        return self._callback

    @callback.setter
    def callback(self, value: Callable[..., Any]) -> None:
        for arguments, kind in (((object(),), Subscription.CallbackType.MessageOnly),
                                ((object(), object()), Subscription.CallbackType.WithMessageInfo)):
            try:
                inspect.signature(value).bind(*arguments)
            except TypeError:
                continue
            self._callback, self._callback_type = value, kind
            return
        raise RuntimeError(
            'Subscription.__init__(): callback should be either be callable with one argument'
            '(to get only the message) or two (to get message and message info)')
