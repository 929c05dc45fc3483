# SPDX-License-Identifier: Apache-2.0
"""List the processes of a launch; launch itself keeps no list."""

from __future__ import annotations

from collections.abc import Iterable

from launch import LaunchContext
from launch.actions import ExecuteLocal
from launch.events.process import ShutdownProcess


class _Census(ShutdownProcess):
    """Collect every process action; shut down none."""

    def __init__(self, found: list[ExecuteLocal]) -> None:
        def note(action: ExecuteLocal) -> bool:
            found.append(action)
            return False  # this process is not to be shut down

        super().__init__(process_matcher=note)


def processes(context: LaunchContext) -> list[ExecuteLocal]:
    """
    Return every process action that was executed, the robot's own included.

    Each process action has a handler that asks an event's matcher about the action. The matcher
    of this event notes the action and does not match. The function calls the handlers itself,
    because the event queue would deliver the answer later.
    """
    found: list[ExecuteLocal] = []
    census = _Census(found)
    for handler in tuple(context._event_handlers):
        if handler.matches(census):
            context._push_locals()
            entities = handler.handle(census, context)
            for entity in entities if isinstance(entities, Iterable) else (entities,):
                if entity is not None:
                    entity.visit(context)
            context._pop_locals()
    return found
