# SPDX-License-Identifier: Apache-2.0
"""Handlers of launch_ros's events."""
from __future__ import annotations

from typing import Any, Callable, Optional

from launch import Event, EventHandler, SomeEntitiesType
from launch._aliases import alias_submodules

from ..actions import LifecycleNode
from ..events.lifecycle import StateTransition

__all__ = ['OnStateTransition']


class OnStateTransition(EventHandler):
    """
    Answers transitions of nodes with a lifecycle: those that fit all that is given.

    :param matcher: decides alone, if given.
    :raises RuntimeError: for a target that isn't a LifecycleNode.
    """

    def __init__(
        self, *, entities: SomeEntitiesType,
        target_lifecycle_node: Optional[LifecycleNode] = None,
        transition: Optional[str] = None, start_state: Optional[str] = None,
        goal_state: Optional[str] = None, matcher: Optional[Callable[[Event], bool]] = None,
        **kwargs: Any
    ) -> None:
        if not isinstance(target_lifecycle_node, (LifecycleNode, type(None))):
            raise RuntimeError(
                "OnStateTransition requires a 'LifecycleNode' action as the target")

        def fits(event: Event) -> bool:
            return (
                isinstance(event, StateTransition)
                and target_lifecycle_node in (None, event.action)
                and transition in (None, event.transition)
                and start_state in (None, event.start_state)
                and goal_state in (None, event.goal_state))

        super().__init__(matcher=matcher or fits, entities=entities, **kwargs)
        self.__target_lifecycle_node = target_lifecycle_node

    @property
    def handler_description(self) -> str:
        return '<actions>'

    @property
    def matcher_description(self) -> str:
        if self.__target_lifecycle_node is None:
            return 'event == StateTransition'
        return ('event == StateTransition and event.action == '
                f'LifecycleNode({hex(id(self.__target_lifecycle_node))})')


alias_submodules(__name__, __all__)
