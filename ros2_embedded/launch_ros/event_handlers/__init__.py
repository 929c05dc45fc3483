# SPDX-License-Identifier: Apache-2.0
"""Handlers of launch_ros's events."""
from __future__ import annotations

from typing import Any, Callable

from launch import Event, EventHandler, SomeEntitiesType

from ..actions import LifecycleNode
from ..events.lifecycle import StateTransition


class OnStateTransition(EventHandler):
    """
    Answers transitions of nodes with a lifecycle: those that fit all that is given.

    :param matcher: decides alone, if given.
    :raises RuntimeError: for a target that isn't a LifecycleNode.
    """

    def __init__(
        self, *, entities: SomeEntitiesType,
        target_lifecycle_node: LifecycleNode | None = None,
        transition: str | None = None, start_state: str | None = None,
        goal_state: str | None = None, matcher: Callable[[Event], bool] | None = None,
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
