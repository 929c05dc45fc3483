# SPDX-License-Identifier: Apache-2.0
"""Apply a function to every entity that some content yields, now or later, before its visit."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Iterator
import contextlib
from typing import Any, Optional

from launch import actions, Event, LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.events import IncludeLaunchDescription

#: Methods of the context by which a visit adds entities for later.
_INTERCEPTED = ('register_event_handler', 'emit_event_sync')

#: Called with each entity before its visit.
Apply = Callable[[LaunchDescriptionEntity, LaunchContext], None]


class Wrapped(LaunchDescriptionEntity):
    """
    An entity to which a function is applied before its visit; its results are wrapped too.

    This includes later results: the actions of a timer, of every event handler that the visit
    registers (``RegisterEventHandler``, ``on_exit=``), and of an include that the visit emits.
    """

    def __init__(self, entity: LaunchDescriptionEntity, apply: Apply) -> None:
        self._entity = entity
        self._apply = apply

    def visit(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Apply the function to the entity, visit it, and wrap the results."""
        entity = self._entity
        self._apply(entity, context)
        if isinstance(entity, actions.TimerAction):
            # its handler serves all timers of the launch, also timers outside this content
            _wrap_result(entity, self._apply)
            return wrap(entity.visit(context), self._apply)
        with _intercepted(context, self._apply):
            return wrap(entity.visit(context), self._apply)

    def also(self, apply: Apply) -> Wrapped:
        """Return the entity with another function, to be applied after its own."""
        first = self._apply

        def both(entity: LaunchDescriptionEntity, context: LaunchContext) -> None:
            first(entity, context)
            apply(entity, context)

        return Wrapped(self._entity, both)

    def get_asyncio_future(self) -> Optional[asyncio.Future[Any]]:
        """Return the entity's own future."""
        future: Optional[asyncio.Future[Any]] = self._entity.get_asyncio_future()
        return future

    def describe(self) -> str:
        """Return the entity's own description."""
        return str(self._entity.describe())

    def describe_sub_entities(self) -> list[LaunchDescriptionEntity]:
        """Return the entity's own sub-entities."""
        return list(self._entity.describe_sub_entities())

    def describe_conditional_sub_entities(
        self,
    ) -> list[tuple[str, Iterable[LaunchDescriptionEntity]]]:
        """Return the entity's own conditional sub-entities."""
        return list(self._entity.describe_conditional_sub_entities())


def below(entity: LaunchDescriptionEntity) -> list[Iterable[LaunchDescriptionEntity]]:
    """Return the entity's sub-entities, and those of each of its conditions."""
    return [entity.describe_sub_entities(), *(
        some for _, some in entity.describe_conditional_sub_entities())]


def everything(
    entities: Iterable[LaunchDescriptionEntity], *, included: bool = False,
) -> Iterator[LaunchDescriptionEntity]:
    """
    Yield entities, and those below them at any depth.

    :param included: also of included files, which launch then reads.
    """
    for entity in entities:
        yield entity
        if included or not isinstance(entity, actions.IncludeLaunchDescription):
            for some in below(entity):
                yield from everything(some, included=included)


def wrap(entities: Any, apply: Apply) -> Optional[list[LaunchDescriptionEntity]]:
    """
    Wrap the result of a visit or a handler: None, an entity, or several.

    If inner content has wrapped an entity, ``apply`` comes after that content's function.
    """
    if entities is None:
        return None
    several: Iterable[Any] = entities if isinstance(entities, Iterable) else (entities,)
    return [entity.also(apply) if isinstance(entity, Wrapped) else Wrapped(entity, apply)
            for entity in several if entity is not None]


def _wrap_result(handles: Any, apply: Apply) -> None:
    """Make the ``handle`` method of a timer or an event handler return wrapped entities."""
    handle = handles.handle

    def wrapped(*args: Any) -> Optional[list[LaunchDescriptionEntity]]:
        # the context is the last argument: handle(context) of a timer, handle(event, context) else
        with _intercepted(args[-1], apply):
            return wrap(handle(*args), apply)

    handles.handle = wrapped


@contextlib.contextmanager
def _intercepted(context: LaunchContext, apply: Apply) -> Iterator[None]:
    """Wrap the results of handlers registered and of includes emitted during the block."""
    register, emit = context.register_event_handler, context.emit_event_sync

    def registering(event_handler: Any, append: bool = False) -> None:
        _wrap_result(event_handler, apply)
        register(event_handler, append=append)

    def emitting(event: Event) -> None:
        if isinstance(event, IncludeLaunchDescription):
            event = IncludeLaunchDescription(
                LaunchDescription(wrap(event.launch_description, apply)))
        emit(event)

    # launch runs one visit at a time, so no other visit uses the context meanwhile
    mine = vars(context)
    outer = {name: mine[name] for name in _INTERCEPTED if name in mine}
    mine.update(dict(zip(_INTERCEPTED, (registering, emitting))))
    try:
        yield
    finally:
        for name in _INTERCEPTED:
            del mine[name]
        mine.update(outer)
