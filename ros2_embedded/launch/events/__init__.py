# SPDX-License-Identifier: Apache-2.0
"""Events of launch itself."""
from __future__ import annotations

from typing import Callable, TYPE_CHECKING

from .._aliases import alias_submodules
from ..event import Event
from . import process

if TYPE_CHECKING:
    from ..action import Action
    from ..actions import TimerAction
    from ..launch_description import LaunchDescription

__all__ = [
    'matches_action',
    'process',
    'ExecutionComplete',
    'IncludeLaunchDescription',
    'Shutdown',
    'TimerEvent',
]


class ExecutionComplete(Event):
    """An action, and what its future stands for, has been executed."""

    name = 'launch.events.ExecutionComplete'

    def __init__(self, *, action: Action) -> None:
        self.__action = action

    @property
    def action(self) -> Action:
        """The action."""
        return self.__action


class IncludeLaunchDescription(Event):
    """A launch description is to be visited."""

    name = 'launch.events.IncludeLaunchDescription'

    def __init__(self, launch_description: LaunchDescription) -> None:
        self.__launch_description = launch_description

    @property
    def launch_description(self) -> LaunchDescription:
        """The launch description."""
        return self.__launch_description


class Shutdown(Event):
    """The launch is to end."""

    name = 'launch.events.Shutdown'

    def __init__(
        self, *, reason: str = 'reason not given', due_to_sigint: bool = False
    ) -> None:
        self.__reason = reason
        self.__due_to_sigint = due_to_sigint

    @property
    def reason(self) -> str:
        """Why, in words."""
        return self.__reason

    @property
    def due_to_sigint(self) -> bool:
        """Whether SIGINT was received, which a terminal sends to the processes too."""
        return self.__due_to_sigint


class TimerEvent(Event):
    """A timer's period has passed."""

    name = 'launch.events.TimerEvent'

    def __init__(self, *, timer_action: TimerAction) -> None:
        self.__timer_action = timer_action

    @property
    def timer_action(self) -> TimerAction:
        """The timer."""
        return self.__timer_action


def matches_action(target_action: Action) -> Callable[[Action], bool]:
    """Return a matcher for that very action."""
    return lambda action: action == target_action


alias_submodules(
    __name__, __all__[2:], {'matchers': ('matches_action',)})
