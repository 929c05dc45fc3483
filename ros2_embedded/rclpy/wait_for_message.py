# SPDX-License-Identifier: Apache-2.0
"""Waiting for one message."""

from typing import Any, TYPE_CHECKING

from rclpy._dds import Guard, WaitSet
from rclpy.qos import QoSProfile
from rclpy.utilities import timeout_sec_to_nsec

if TYPE_CHECKING:
    from rclpy.node import Node


def wait_for_message(msg_type: Any, node: 'Node', topic: str, *,
                     qos_profile: QoSProfile | int = 1,
                     time_to_wait: float = -1) -> tuple[bool, Any]:
    """
    Wait for the next message of a topic, without an executor.

    :param time_to_wait: in seconds; negative: without limit.
    :returns: whether there was one, and the message or None.
    """
    subscription = node.create_subscription(msg_type, topic, lambda _: None, qos_profile)
    guard, waiting = Guard(), WaitSet()
    node.context._wakers.add(guard.trigger)
    try:
        handle = subscription._handle()
        assert handle is not None
        waiting.attach({handle, guard.handle})
        limit = timeout_sec_to_nsec(time_to_wait)
        waiting.wait(limit if limit >= 0 else 2 ** 62)
        taken = subscription._next() if node.context.ok() else None
    finally:
        node.context._wakers.discard(guard.trigger)
        waiting.close()
        guard.close()
        node.destroy_subscription(subscription)
    return (False, None) if taken is None else (True, taken[0])
