# SPDX-License-Identifier: Apache-2.0
"""Bases of all event handlers."""
from __future__ import annotations

from typing import Any, Callable, List, Optional, Tuple, TYPE_CHECKING

from .event import Event
from .some_entities_type import SomeEntitiesType

if TYPE_CHECKING:
    from .launch_context import LaunchContext


class BaseEventHandler:
    """
    Answers events with entities to visit.

    :param matcher: says whether an event is this handler's.
    :param handle_once: whether the handler goes with the first event it handles.
    """

    def __init__(self, *, matcher: Callable[[Event], bool], handle_once: bool = False) -> None:
        self.__matcher = matcher
        self.__handle_once = handle_once

    @property
    def handle_once(self) -> bool:
        """Whether the handler goes with the first event it handles."""
        return self.__handle_once

    @property
    def handler_description(self) -> Optional[str]:
        """What the handler does, in words."""
        return None

    @property
    def matcher_description(self) -> Optional[str]:
        """What the handler matches, in words."""
        return None

    def matches(self, event: Event) -> bool:
        """Say whether the event is this handler's."""
        return self.__matcher(event)

    def describe(self) -> Tuple[str, List[Any]]:
        """Return a description for humans, and the entities that the handler may return."""
        text = (f"{type(self).__name__}(matcher='{self.matcher_description}', "
                f"handler='{self.handler_description}', handle_once={self.handle_once})")
        return text, []

    def handle(self, event: Event, context: LaunchContext) -> Optional[SomeEntitiesType]:
        """Put the event into the context's locals; return what is to be visited."""
        context.extend_locals({'event': event})
        if self.handle_once:
            context.unregister_event_handler(self)
        return None


class EventHandler(BaseEventHandler):
    """Answers matching events with fixed entities."""

    def __init__(
        self, *, matcher: Callable[[Event], bool], entities: Optional[SomeEntitiesType] = None,
        handle_once: bool = False
    ) -> None:
        super().__init__(matcher=matcher, handle_once=handle_once)
        self.__entities = entities

    @property
    def entities(self) -> Optional[SomeEntitiesType]:
        """The entities that an event yields."""
        return self.__entities

    def describe(self) -> Tuple[str, List[Any]]:
        text, entities = super().describe()
        if self.__entities:
            entities.extend(self.__entities)  # type: ignore[arg-type]
        return text, entities

    def handle(self, event: Event, context: LaunchContext) -> Optional[SomeEntitiesType]:
        super().handle(event, context)
        return self.__entities
