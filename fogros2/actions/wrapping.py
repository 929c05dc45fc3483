# SPDX-License-Identifier: Apache-2.0
"""A look at every entity that some content yields, now or later, before launch visits it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Iterator
import contextlib
from typing import Any, Optional

from launch import Event, LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import TimerAction
from launch.events import IncludeLaunchDescription

#: Methods of the context through which something can come later.
_INTERCEPTED = ('register_event_handler', 'emit_event_sync')

#: What is done with an entity before it is visited.
Apply = Callable[[LaunchDescriptionEntity, LaunchContext], None]


class Wrapped(LaunchDescriptionEntity):
    """
    Another entity, looked at first; what its visit yields is wrapped likewise.

    That holds for what comes later too: the actions of a timer, of every event handler that the
    visit registers (``RegisterEventHandler``, ``on_exit=``), and of an include that it emits.
    """

    def __init__(self, entity: LaunchDescriptionEntity, apply: Apply) -> None:
        self._entity = entity
        self._apply = apply

    def visit(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Look at the entity, visit it, and wrap what it yields."""
        entity = self._entity
        self._apply(entity, context)
        if isinstance(entity, TimerAction):
            # the handler it registers is one for all timers of the launch, others' as well
            _wrap_result(entity, self._apply)
            return wrap(entity.visit(context), self._apply)
        with _intercepted(context, self._apply):
            return wrap(entity.visit(context), self._apply)

    def get_asyncio_future(self) -> Optional[asyncio.Future[Any]]:
        """Return the entity's own."""
        future: Optional[asyncio.Future[Any]] = self._entity.get_asyncio_future()
        return future

    def describe(self) -> str:
        """Return the entity's own description."""
        return str(self._entity.describe())

    def describe_sub_entities(self) -> list[LaunchDescriptionEntity]:
        """Return the entity's own."""
        return list(self._entity.describe_sub_entities())

    def describe_conditional_sub_entities(
        self,
    ) -> list[tuple[str, Iterable[LaunchDescriptionEntity]]]:
        """Return the entity's own."""
        return list(self._entity.describe_conditional_sub_entities())


def wrap(entities: Any, apply: Apply) -> Optional[list[LaunchDescriptionEntity]]:
    """Wrap what a visit or a handler returned: nothing, an entity, or several."""
    if entities is None:
        return None
    several: Iterable[Any] = entities if isinstance(entities, Iterable) else (entities,)
    return [Wrapped(entity, apply) for entity in several if entity is not None]


def _wrap_result(handles: Any, apply: Apply) -> None:
    """Have the ``handle`` method of a timer or an event handler return wrapped entities."""
    handle = handles.handle

    def wrapped(*args: Any) -> Optional[list[LaunchDescriptionEntity]]:
        # the context comes last: handle(context) of a timer, handle(event, context) of the rest
        with _intercepted(args[-1], apply):
            return wrap(handle(*args), apply)

    handles.handle = wrapped


@contextlib.contextmanager
def _intercepted(context: LaunchContext, apply: Apply) -> Iterator[None]:
    """Wrap what will come of the handlers registered and the includes emitted meanwhile."""
    register, emit = context.register_event_handler, context.emit_event_sync

    def registering(event_handler: Any, append: bool = False) -> None:
        _wrap_result(event_handler, apply)
        register(event_handler, append=append)

    def emitting(event: Event) -> None:
        if isinstance(event, IncludeLaunchDescription):
            event = IncludeLaunchDescription(
                LaunchDescription(wrap(event.launch_description, apply)))
        emit(event)

    # launch runs one visit at a time, so the context is ours until this one is over
    mine = vars(context)
    outer = {name: mine[name] for name in _INTERCEPTED if name in mine}
    mine.update(dict(zip(_INTERCEPTED, (registering, emitting))))
    try:
        yield
    finally:
        for name in _INTERCEPTED:
            del mine[name]
        mine.update(outer)
