# SPDX-License-Identifier: Apache-2.0
"""What an executor and a node know of the things that have callbacks."""

from collections.abc import Callable
from typing import Any

from rclpy.exceptions import InvalidHandle

Work = tuple[Callable[..., Any], tuple[Any, ...], Callable[[Any], None] | None]
"""A callback, its arguments, and what is done with its result."""


class Entity:
    """
    The base of publishers, subscriptions, timers, services, clients, guard conditions and events.

    :param ends: what it holds of DDS, to be closed when it is destroyed.
    """

    callback_group: Any = None
    _destroyed = False

    def __init__(self, *ends: Any) -> None:
        self._ends = list(ends)

    def _handle(self) -> int | None:
        """What triggers it in a wait set; None: nothing."""
        return None

    def _is_triggered(self) -> bool:
        """Whether there really is something, once its handle has triggered."""
        return True

    def _take(self, executor: Any) -> Work | None:
        """Take what is there; None if there is nothing after all."""
        return None

    def _check_alive(self) -> None:
        if self._destroyed:
            raise InvalidHandle('cannot use Destroyable because destruction was requested')

    @property
    def handle(self) -> Any:
        """Itself: programs ask for it to see whether there is one."""
        self._check_alive()
        return self

    def destroy(self) -> None:
        """Free it; a program calls a node's ``destroy_publisher()`` and so on."""
        if not self._destroyed:
            self._destroyed = True
            for end in self._ends:
                end.close()
