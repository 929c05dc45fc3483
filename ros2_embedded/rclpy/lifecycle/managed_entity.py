# SPDX-License-Identifier: Apache-2.0
"""What takes part in a node's transitions."""

from enum import Enum
from typing import Any


class TransitionCallbackReturn(Enum):
    """How a transition went."""

    SUCCESS = 97
    FAILURE = 98
    ERROR = 99


class ManagedEntity:
    """Takes part in transitions; does nothing by default."""

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        """Do nothing, with success; likewise in the other transitions."""
        return TransitionCallbackReturn.SUCCESS

    on_cleanup = on_shutdown = on_activate = on_deactivate = on_error = on_configure


class SimpleManagedEntity(ManagedEntity):
    """Knows whether it is active."""

    def __init__(self) -> None:
        self._enabled = False

    def on_activate(self, state: Any) -> TransitionCallbackReturn:
        """Note it."""
        self._enabled = True
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: Any) -> TransitionCallbackReturn:
        """Note it."""
        self._enabled = False
        return TransitionCallbackReturn.SUCCESS

    @property
    def is_activated(self) -> bool:
        """Whether it is active."""
        return self._enabled
