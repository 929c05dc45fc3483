# SPDX-License-Identifier: Apache-2.0
"""
Waitables: what an executor waits for besides the usual.

Those that programs write are based on rcl's wait sets, which there are none of here.
"""

from typing import Any

from rclpy._entity import Entity
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import NotEmbeddedError


class Waitable(Entity):
    """The base of event handlers."""

    def __init__(self, callback_group: CallbackGroup) -> None:
        if type(self).__module__.partition('.')[0] != 'rclpy':
            raise NotEmbeddedError("a Waitable of one's own")
        self.callback_group = callback_group
        self.callback_group.add_entity(self)
        self._futures: list[Any] = []

    def add_future(self, future: Any) -> None:
        """Have the executor know a future."""
        self._futures.append(future)

    def remove_future(self, future: Any) -> None:
        """Have the executor forget a future."""
        self._futures.remove(future)
