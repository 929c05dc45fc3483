# SPDX-License-Identifier: Apache-2.0
"""Events of launch itself."""
from __future__ import annotations

from typing import Any, Callable

from embedded_default.lacking import lacking

from .._base import Action, Event
from . import process as process

__getattr__ = lacking(__name__, 'ExecutionComplete')


class IncludeLaunchDescription(Event):
    """A launch description is to be visited."""

    def __init__(self, launch_description: Any) -> None:
        self.launch_description = launch_description


class Shutdown(Event):
    """The launch is to end; a SIGINT, as a terminal sends it, reaches the processes too."""

    def __init__(self, *, reason: str = 'reason not given', due_to_sigint: bool = False) -> None:
        self.reason = reason
        self.due_to_sigint = due_to_sigint


class TimerEvent(Event):
    """A timer's period has passed."""

    def __init__(self, *, timer_action: Any) -> None:
        self.timer_action = timer_action


def matches_action(target_action: Action) -> Callable[[Action], bool]:
    return lambda action: action == target_action
