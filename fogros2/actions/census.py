# SPDX-License-Identifier: Apache-2.0
"""Which processes a launch has: launch itself keeps no list."""

from __future__ import annotations

from collections.abc import Iterable

from launch import LaunchContext
from launch.actions import ExecuteLocal
from launch.events.process import ShutdownProcess


class _Census(ShutdownProcess):
    """Asks every process action for itself; shuts none of them down."""

    def __init__(self, found: list[ExecuteLocal]) -> None:
        def note(action: ExecuteLocal) -> bool:
            found.append(action)
            return False  # not meant for this one

        super().__init__(process_matcher=note)


def processes(context: LaunchContext) -> list[ExecuteLocal]:
    """
    Return every process action that was executed, the robot's own too.

    Each has a handler that asks an event's matcher about the action; this one notes it and says
    no. Handled here and not by the event queue, so that the answer is there at once.
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
