# SPDX-License-Identifier: Apache-2.0
"""What an executor knows of the things it waits for."""

from collections.abc import Callable
from typing import Any

Work = tuple[Callable[..., Any], tuple[Any, ...], Callable[[Any], None] | None]
"""A callback, its arguments, and what is done with its result."""


class Entity:
    """The base of subscriptions, timers, services, clients, guard conditions and waitables."""

    callback_group: Any = None

    def _handle(self) -> int | None:
        """What triggers it in a wait set; None: nothing."""
        return None

    def _is_triggered(self) -> bool:
        """Whether there really is something, once its handle has triggered."""
        return True

    def _take(self, executor: Any) -> Work | None:
        """Take what is there; None if there is nothing after all."""
        raise AssertionError

    @property
    def handle(self) -> Any:
        """Itself: programs ask for it to see whether there is one."""
        return self
