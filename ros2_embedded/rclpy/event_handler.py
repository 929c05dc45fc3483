# SPDX-License-Identifier: Apache-2.0
"""Events of publishers and subscriptions: matches, missed deadlines, incompatible QoS."""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

from rclpy import _dds
from rclpy._entity import Work
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import UnsupportedEventTypeError
from rclpy.logging import get_logger
from rclpy.qos import qos_policy_name_from_kind, QoSPolicyKind
from rclpy.waitable import Waitable


class QoSPublisherEventType(IntEnum):
    """Events of a publisher."""

    RCL_PUBLISHER_OFFERED_DEADLINE_MISSED = 0
    RCL_PUBLISHER_LIVELINESS_LOST = 1
    RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS = 2
    RCL_PUBLISHER_INCOMPATIBLE_TYPE = 3
    RCL_PUBLISHER_MATCHED = 4


class QoSSubscriptionEventType(IntEnum):
    """Events of a subscription."""

    RCL_SUBSCRIPTION_REQUESTED_DEADLINE_MISSED = 0
    RCL_SUBSCRIPTION_LIVELINESS_CHANGED = 1
    RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS = 2
    RCL_SUBSCRIPTION_MESSAGE_LOST = 3
    RCL_SUBSCRIPTION_INCOMPATIBLE_TYPE = 4
    RCL_SUBSCRIPTION_MATCHED = 5


class QoSRequestedDeadlineMissedInfo(NamedTuple):
    """How often a deadline was missed."""

    total_count: int
    total_count_change: int


QoSOfferedDeadlineMissedInfo = QoSRequestedDeadlineMissedInfo


class QoSLivelinessLostInfo(NamedTuple):
    """How often a publisher didn't say in time that it is alive."""

    total_count: int
    total_count_change: int


class QoSMessageLostInfo(NamedTuple):
    """How many messages were lost."""

    total_count: int
    total_count_change: int


class QoSLivelinessChangedInfo(NamedTuple):
    """How many publishers are alive, and how many have been."""

    alive_count: int
    not_alive_count: int
    alive_count_change: int
    not_alive_count_change: int


class QoSRequestedIncompatibleQoSInfo(NamedTuple):
    """How many others didn't match, and because of what at last."""

    total_count: int
    total_count_change: int
    last_policy_kind: int


QoSOfferedIncompatibleQoSInfo = QoSRequestedIncompatibleQoSInfo


class QoSSubscriptionMatchedInfo(NamedTuple):
    """How many others match, and have matched."""

    total_count: int
    total_count_change: int
    current_count: int
    current_count_change: int


QoSPublisherMatchedInfo = QoSSubscriptionMatchedInfo


class IncompatibleTypeInfo(NamedTuple):
    """How many others had another type."""

    total_count: int
    total_count_change: int


# DDS's policy ids in ROS's terms
_POLICIES = {2: QoSPolicyKind.DURABILITY, 4: QoSPolicyKind.DEADLINE, 8: QoSPolicyKind.LIVELINESS,
             11: QoSPolicyKind.RELIABILITY, 13: QoSPolicyKind.HISTORY, 21: QoSPolicyKind.LIFESPAN}

# an event's status in DDS, its bit, and what ROS tells of it
_PUBLISHER: dict[int, tuple[str, int, Any]] = {
    0: ('offered_deadline_missed', _dds.OFFERED_DEADLINE, QoSOfferedDeadlineMissedInfo),
    1: ('liveliness_lost', _dds.LIVELINESS_LOST, QoSLivelinessLostInfo),
    2: ('offered_incompatible_qos', _dds.OFFERED_QOS, QoSOfferedIncompatibleQoSInfo),
    4: ('publication_matched', _dds.PUBLICATION_MATCHED, QoSPublisherMatchedInfo)}
_SUBSCRIPTION: dict[int, tuple[str, int, Any]] = {
    0: ('requested_deadline_missed', _dds.REQUESTED_DEADLINE, QoSRequestedDeadlineMissedInfo),
    1: ('liveliness_changed', _dds.LIVELINESS_CHANGED, QoSLivelinessChangedInfo),
    2: ('requested_incompatible_qos', _dds.REQUESTED_QOS, QoSRequestedIncompatibleQoSInfo),
    3: ('sample_lost', _dds.SAMPLE_LOST, QoSMessageLostInfo),
    5: ('subscription_matched', _dds.SUBSCRIPTION_MATCHED, QoSSubscriptionMatchedInfo)}


class EventHandler(Waitable):
    """
    Calls back for an event.

    :raises UnsupportedEventTypeError: if the middleware doesn't have it.
    """

    def __init__(self, *, callback_group: CallbackGroup, callback: Callable[[Any], Any],
                 event_type: IntEnum, parent_impl: _dds.Reader | _dds.Writer) -> None:
        table = _PUBLISHER if isinstance(event_type, QoSPublisherEventType) else _SUBSCRIPTION
        if event_type not in table:
            raise UnsupportedEventTypeError(f'{event_type.name} is not supported')
        super().__init__(callback_group)
        self.event_type = event_type
        self.callback = callback
        self._name, self._bit, self._info = table[event_type]
        self._entity = parent_impl
        parent_impl.watched |= self._bit
        parent_impl.watch(parent_impl.watched)

    def _handle(self) -> int | None:
        return self._entity.handle

    def _is_triggered(self) -> bool:
        return bool(self._entity.status_changes() & self._bit)

    def _take(self, executor: Any) -> Work | None:
        if not self._is_triggered():
            return None
        numbers, _ = self._entity.status(self._name)
        values: list[int] = list(numbers[:len(self._info._fields)])
        if self._info is QoSRequestedIncompatibleQoSInfo:
            values[2] = _POLICIES.get(values[2], QoSPolicyKind.INVALID)
        return self.callback, (self._info(*values),), None

    def destroy(self) -> None:
        """Stop watching."""


QoSEventHandler = EventHandler


def _handlers(wanted: list[tuple[Any, IntEnum]], group: CallbackGroup,
              parent: _dds.Reader | _dds.Writer) -> list[EventHandler]:
    return [EventHandler(callback_group=group, callback=callback, event_type=kind,
                         parent_impl=parent) for callback, kind in wanted if callback]


class SubscriptionEventCallbacks:
    """A subscription's callbacks for events."""

    def __init__(self, *, deadline: Callable[[Any], None] | None = None,
                 incompatible_qos: Callable[[Any], None] | None = None,
                 liveliness: Callable[[Any], None] | None = None,
                 message_lost: Callable[[Any], None] | None = None,
                 incompatible_type: Callable[[Any], None] | None = None,
                 matched: Callable[[Any], None] | None = None,
                 use_default_callbacks: bool = True) -> None:
        self.deadline = deadline
        self.incompatible_qos = incompatible_qos
        self.liveliness = liveliness
        self.message_lost = message_lost
        self.incompatible_type = incompatible_type  # Cyclone DDS never reports it
        self.matched = matched
        self.use_default_callbacks = use_default_callbacks

    def create_event_handlers(self, callback_group: CallbackGroup, subscription: _dds.Reader,
                              topic_name: str, logger_name: str) -> list[EventHandler]:
        """Make the handlers; incompatible QoS is warned of by default."""
        def warn(event: Any) -> None:
            get_logger(logger_name).warning(
                f"New publisher discovered on topic '{topic_name}', offering incompatible QoS. "
                'No messages will be received from it. Last incompatible policy: '
                f'{qos_policy_name_from_kind(event.last_policy_kind)}')

        kind = QoSSubscriptionEventType
        fallback = warn if self.use_default_callbacks else None
        return _handlers([
            (self.deadline, kind.RCL_SUBSCRIPTION_REQUESTED_DEADLINE_MISSED),
            (self.incompatible_qos or fallback, kind.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS),
            (self.liveliness, kind.RCL_SUBSCRIPTION_LIVELINESS_CHANGED),
            (self.message_lost, kind.RCL_SUBSCRIPTION_MESSAGE_LOST),
            (self.matched, kind.RCL_SUBSCRIPTION_MATCHED)], callback_group, subscription)


class PublisherEventCallbacks:
    """A publisher's callbacks for events."""

    def __init__(self, *, deadline: Callable[[Any], None] | None = None,
                 liveliness: Callable[[Any], None] | None = None,
                 incompatible_qos: Callable[[Any], None] | None = None,
                 incompatible_type: Callable[[Any], None] | None = None,
                 matched: Callable[[Any], None] | None = None,
                 use_default_callbacks: bool = True) -> None:
        self.deadline = deadline
        self.liveliness = liveliness
        self.incompatible_qos = incompatible_qos
        self.incompatible_type = incompatible_type  # Cyclone DDS never reports it
        self.matched = matched
        self.use_default_callbacks = use_default_callbacks

    def create_event_handlers(self, callback_group: CallbackGroup, publisher: _dds.Writer,
                              topic_name: str, logger_name: str) -> list[EventHandler]:
        """Make the handlers; incompatible QoS is warned of by default."""
        def warn(event: Any) -> None:
            get_logger(logger_name).warning(
                f"New subscription discovered on topic '{topic_name}', requesting incompatible "
                'QoS. No messages will be sent to it. Last incompatible policy: '
                f'{qos_policy_name_from_kind(event.last_policy_kind)}')

        kind = QoSPublisherEventType
        fallback = warn if self.use_default_callbacks else None
        return _handlers([
            (self.deadline, kind.RCL_PUBLISHER_OFFERED_DEADLINE_MISSED),
            (self.liveliness, kind.RCL_PUBLISHER_LIVELINESS_LOST),
            (self.incompatible_qos or fallback, kind.RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS),
            (self.matched, kind.RCL_PUBLISHER_MATCHED)], callback_group, publisher)
