# SPDX-License-Identifier: Apache-2.0
"""Callback groups say which callbacks may run at the same time."""

import threading
from typing import Any
import weakref


class CallbackGroup:
    """The base of callback groups."""

    def __init__(self) -> None:
        self.entities: set[Any] = set()

    def add_entity(self, entity: Any) -> None:
        """Add a subscription, timer, client, service, guard condition or waitable."""
        self.entities.add(weakref.ref(entity, self.entities.discard))

    def can_execute(self, entity: Any) -> bool:
        """Say whether the entity's callback could be executed."""
        raise NotImplementedError()

    def beginning_execution(self, entity: Any) -> bool:
        """Ask for permission to execute the entity's callback."""
        raise NotImplementedError()

    def ending_execution(self, entity: Any) -> None:
        """Say that the entity's callback has been executed."""
        raise NotImplementedError()


class ReentrantCallbackGroup(CallbackGroup):
    """All callbacks may run at the same time."""

    def can_execute(self, entity: Any) -> bool:
        """Say yes."""
        return True

    def beginning_execution(self, entity: Any) -> bool:
        """Say yes."""
        return True

    def ending_execution(self, entity: Any) -> None:
        """Note nothing."""


class MutuallyExclusiveCallbackGroup(CallbackGroup):
    """One callback at a time may run."""

    def __init__(self) -> None:
        super().__init__()
        self._active_entity: Any = None
        self._lock = threading.Lock()

    def can_execute(self, entity: Any) -> bool:
        """Say whether no callback is running."""
        return self._active_entity is None

    def beginning_execution(self, entity: Any) -> bool:
        """Give permission if no callback is running."""
        with self._lock:
            if self._active_entity is None:
                self._active_entity = entity
                return True
            return False

    def ending_execution(self, entity: Any) -> None:
        """Let the next one run."""
        with self._lock:
            assert self._active_entity is entity
            self._active_entity = None
