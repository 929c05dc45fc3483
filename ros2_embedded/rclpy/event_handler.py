# SPDX-License-Identifier: Apache-2.0
"""Events of publishers and subscriptions: matches, missed deadlines, incompatible QoS."""

from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy import _dds
from rclpy._entity import Entity, Work
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import UnsupportedEventTypeError as UnsupportedEventTypeError
from rclpy.logging import get_logger
from rclpy.qos import qos_policy_name_from_kind, QoSPolicyKind
from rosidl_embedded.lacking import lacking

__getattr__ = lacking(__name__, 'QoSPublisherEventType QoSSubscriptionEventType')


class _Count(NamedTuple):
    """How often it happened, and how often since the last time."""

    total_count: int
    total_count_change: int


QoSRequestedDeadlineMissedInfo = QoSOfferedDeadlineMissedInfo = _Count
QoSLivelinessLostInfo = QoSMessageLostInfo = IncompatibleTypeInfo = _Count


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


# DDS's policy ids in ROS's terms
_POLICIES = {2: QoSPolicyKind.DURABILITY, 4: QoSPolicyKind.DEADLINE, 8: QoSPolicyKind.LIVELINESS,
             11: QoSPolicyKind.RELIABILITY, 13: QoSPolicyKind.HISTORY, 21: QoSPolicyKind.LIFESPAN}

class Kind(NamedTuple):
    """A kind of event: its status and that status's bit in DDS, and what ROS tells of it."""

    status: str
    bit: int
    info: Any


class EventHandler(Entity):
    """Calls back for an event."""

    def __init__(self, *, callback_group: CallbackGroup, callback: Callable[[Any], Any],
                 event_type: Kind, parent_impl: _dds.Reader | _dds.Writer) -> None:
        super().__init__()
        self.callback_group = callback_group
        callback_group.add_entity(self)
        self.event_type = event_type
        self.callback = callback
        self._entity = parent_impl
        parent_impl.watched |= event_type.bit
        parent_impl.watch(parent_impl.watched)

    def _handle(self) -> int | None:
        return self._entity.handle

    def _is_triggered(self) -> bool:
        return bool(self._entity.status_changes() & self.event_type.bit)

    def _take(self, executor: Any) -> Work | None:
        if not self._is_triggered():
            return None
        info = self.event_type.info
        values = list(self._entity.status(self.event_type.status)[:len(info._fields)])
        if info is QoSRequestedIncompatibleQoSInfo:
            values[2] = _POLICIES.get(values[2], QoSPolicyKind.INVALID)
        return self.callback, (info(*values),), None


QoSEventHandler = EventHandler


class _Callbacks:
    """Callbacks for events, given by name; a name that there isn't is a TypeError."""

    _kinds: dict[str, Kind]
    _warning: str

    def __init__(self, *, use_default_callbacks: bool = True,
                 incompatible_type: Callable[[Any], None] | None = None,
                 **callbacks: Callable[[Any], None] | None) -> None:
        unknown = sorted(callbacks.keys() - self._kinds.keys())
        if unknown:
            raise TypeError(f"{type(self).__name__} got an unexpected keyword argument "
                            f"'{unknown[0]}'")
        self.use_default_callbacks = use_default_callbacks
        self.incompatible_type = incompatible_type  # Cyclone DDS never reports it
        for name in self._kinds:
            setattr(self, name, callbacks.get(name))

    def create_event_handlers(
            self, callback_group: CallbackGroup, parent: _dds.Reader | _dds.Writer,
            topic_name: str, logger_name: str) -> list[EventHandler]:
        """Make the handlers; incompatible QoS is warned of by default."""
        def warn(event: Any) -> None:
            get_logger(logger_name).warning(self._warning.format(
                topic_name, qos_policy_name_from_kind(event.last_policy_kind)))

        handlers = []
        for name, kind in self._kinds.items():
            callback = getattr(self, name)
            if callback is None and name == 'incompatible_qos' and self.use_default_callbacks:
                callback = warn
            if callback is not None:
                handlers.append(EventHandler(callback_group=callback_group, callback=callback,
                                             event_type=kind, parent_impl=parent))
        return handlers


class SubscriptionEventCallbacks(_Callbacks):
    """A subscription's callbacks for events."""

    _kinds = {
        'deadline': Kind('requested_deadline_missed', _dds.REQUESTED_DEADLINE,
                         QoSRequestedDeadlineMissedInfo),
        'incompatible_qos': Kind('requested_incompatible_qos', _dds.REQUESTED_QOS,
                                 QoSRequestedIncompatibleQoSInfo),
        'liveliness': Kind('liveliness_changed', _dds.LIVELINESS_CHANGED,
                           QoSLivelinessChangedInfo),
        'message_lost': Kind('sample_lost', _dds.SAMPLE_LOST, QoSMessageLostInfo),
        'matched': Kind('subscription_matched', _dds.SUBSCRIPTION_MATCHED,
                        QoSSubscriptionMatchedInfo)}
    _warning = ("New publisher discovered on topic '{}', offering incompatible QoS. No messages "
                'will be received from it. Last incompatible policy: {}')


class PublisherEventCallbacks(_Callbacks):
    """A publisher's callbacks for events."""

    _kinds = {
        'deadline': Kind('offered_deadline_missed', _dds.OFFERED_DEADLINE,
                         QoSOfferedDeadlineMissedInfo),
        'incompatible_qos': Kind('offered_incompatible_qos', _dds.OFFERED_QOS,
                                 QoSOfferedIncompatibleQoSInfo),
        'liveliness': Kind('liveliness_lost', _dds.LIVELINESS_LOST, QoSLivelinessLostInfo),
        'matched': Kind('publication_matched', _dds.PUBLICATION_MATCHED,
                        QoSPublisherMatchedInfo)}
    _warning = ("New subscription discovered on topic '{}', requesting incompatible QoS. No "
                'messages will be sent to it. Last incompatible policy: {}')
