# SPDX-License-Identifier: Apache-2.0
"""Guard conditions: a program calls its executor."""

from collections.abc import Callable
from typing import Any

from rclpy._dds import Guard
from rclpy._entity import Entity, Work
from rclpy.callback_groups import CallbackGroup
from rclpy.context import Context


class GuardCondition(Entity):
    """Calls back after :meth:`trigger`; made by :meth:`.Node.create_guard_condition`."""

    def __init__(self, callback: Callable[[], Any] | None, callback_group: CallbackGroup | None,
                 context: Context | None = None) -> None:
        self.callback = callback
        self.callback_group = callback_group
        self._guard = Guard()
        super().__init__(self._guard)

    def _handle(self) -> int | None:
        return None if self._destroyed else self._guard.handle

    def _take(self, executor: Any) -> Work | None:
        if self._destroyed or not self._guard.take() or self.callback is None:
            return None
        return self.callback, (), None

    def trigger(self) -> None:
        """
        Have the callback called.

        :raises InvalidHandle: if it was destroyed.
        """
        self._check_alive()
        self._guard.trigger()
