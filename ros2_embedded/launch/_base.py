# SPDX-License-Identifier: Apache-2.0
"""What events, substitutions, conditions, event handlers and actions derive from."""
from __future__ import annotations

import asyncio
import collections.abc
from typing import Any, Callable, Dict, Iterable, List, Optional, Tuple, Type, TYPE_CHECKING, Union

if TYPE_CHECKING:
    from .frontend import Entity, Parser
    from .launch_context import LaunchContext


class Event:
    name = 'launch.Event'


class Substitution:
    """A text that is only known when the launch runs."""

    def describe(self) -> str:
        return repr(self)

    def perform(self, context: LaunchContext) -> str:
        raise NotImplementedError('perform() not implemented for Substitution base class.')


SomeSubstitutionsType = Union[str, Substitution, Iterable[Union[str, Substitution]]]
SomeSubstitutionsType_types_tuple = (str, Substitution, collections.abc.Iterable)


class Condition:
    """Decides, when an action is visited, whether it executes."""

    def __init__(self, *, predicate: Optional[Callable[[LaunchContext], bool]] = None) -> None:
        self._predicate = predicate

    def describe(self) -> str:
        return repr(self)

    def evaluate(self, context: LaunchContext) -> bool:
        return False if self._predicate is None else self._predicate(context)


class LaunchDescriptionEntity:
    """Something that launch visits, with other entities below it."""

    def describe(self) -> str:
        raise NotImplementedError()

    def describe_sub_entities(self) -> List[LaunchDescriptionEntity]:
        return []

    def describe_conditional_sub_entities(
        self
    ) -> List[Tuple[str, Iterable[LaunchDescriptionEntity]]]:
        return []

    def visit(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        """Do the entity's work; return what is to be visited next, in order."""
        return None

    def get_asyncio_future(self) -> Optional[asyncio.Future[Any]]:
        """Return what launch waits for before it is idle."""
        return None


Entities = List[LaunchDescriptionEntity]
SomeEntitiesType = Union[LaunchDescriptionEntity, Iterable[LaunchDescriptionEntity]]
SomeEntitiesType_types_tuple = (LaunchDescriptionEntity, collections.abc.Iterable)


class BaseEventHandler:
    """Answers the events that the matcher picks; ``handle_once``: only the first of them."""

    def __init__(self, *, matcher: Callable[[Event], bool], handle_once: bool = False) -> None:
        self.__matcher = matcher
        self.__handle_once = handle_once

    @property
    def handle_once(self) -> bool:
        return self.__handle_once

    @property
    def handler_description(self) -> Optional[str]:
        return None

    @property
    def matcher_description(self) -> Optional[str]:
        return None

    def matches(self, event: Event) -> bool:
        return self.__matcher(event)

    def describe(self) -> Tuple[str, List[Any]]:
        """Return a text for humans, and the entities that the handler may return."""
        return (f"{type(self).__name__}(matcher='{self.matcher_description}', handler="
                f"'{self.handler_description}', handle_once={self.handle_once})"), []

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
        return self.__entities

    def describe(self) -> Tuple[str, List[Any]]:
        text, entities = super().describe()
        if self.__entities:
            entities.extend(self.__entities)  # type: ignore[arg-type]
        return text, entities

    def handle(self, event: Event, context: LaunchContext) -> Optional[SomeEntitiesType]:
        super().handle(event, context)
        return self.__entities


ParsedAction = Tuple[Type['Action'], Dict[str, Any]]


class Action(LaunchDescriptionEntity):
    """An entity that does something, if the condition holds."""

    #: For :meth:`parse`: arguments that are texts with substitutions, and their attributes in
    #: launch files; a question mark where they may be absent.
    _texts: Dict[str, str] = {}

    def __init__(self, *, condition: Optional[Condition] = None) -> None:
        self.__condition = condition

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        """
        Return the class and the keyword arguments that a frontend's entity gives.

        :raises RuntimeError: for both ``if`` and ``unless``.
        """
        from .conditions import IfCondition, UnlessCondition
        kwargs: Dict[str, Any] = {}
        for name, kind in (('if', IfCondition), ('unless', UnlessCondition)):
            expression = entity.get_attr(name, optional=True)
            if expression is not None:
                if kwargs:
                    raise RuntimeError("if and unless conditions can't be used simultaneously")
                kwargs['condition'] = kind(parser.parse_substitution(expression))
        for argument, attribute in cls._texts.items():
            text = entity.get_attr(attribute.rstrip('?'), optional=attribute.endswith('?'))
            if text is not None:
                kwargs[argument] = parser.parse_substitution(text)
        return cls, kwargs

    @property
    def condition(self) -> Optional[Condition]:
        return self.__condition

    def describe(self) -> str:
        return repr(self)

    def get_sub_entities(self) -> Entities:
        """Return what executing the action yields, as far as it is known before."""
        return []

    def describe_sub_entities(self) -> Entities:
        return self.get_sub_entities() if self.condition is None else []

    def describe_conditional_sub_entities(
        self
    ) -> List[Tuple[str, Iterable[LaunchDescriptionEntity]]]:
        if self.condition is None:
            return []
        return [(f'Conditionally included by {self.describe()}', self.get_sub_entities())]

    def visit(self, context: LaunchContext) -> Optional[Entities]:
        """Execute if the condition holds; ExecutionComplete follows, if anybody listens."""
        if self.__condition is not None and not self.__condition.evaluate(context):
            return None
        try:
            return self.execute(context)
        finally:
            from .events import ExecutionComplete
            event = ExecutionComplete(action=self)
            if context.would_handle_event(event):
                future = self.get_asyncio_future()
                if future is None:
                    context.emit_event_sync(event)
                else:
                    future.add_done_callback(lambda _: context.emit_event_sync(event))

    def execute(self, context: LaunchContext) -> Optional[Entities]:
        """Do the action's work, without blocking; return what is to be visited next."""
        return None


class InvalidLaunchFileError(Exception):
    """No loader could read a launch file; the first of their errors is the likeliest."""

    def __init__(
        self, extension: str = '', *, likely_errors: Optional[List[Exception]] = None
    ) -> None:
        self._extension = extension
        self._likely_errors = likely_errors
        text = 'The launch file may have a syntax error, or its format is unknown'
        if extension and likely_errors:
            kind = 'multiple exceptions' if len(likely_errors) > 1 else 'exception'
            text = '\n - '.join([
                f'Caught {kind} when trying to load file of format [{extension}]:',
                *(f'{type(error).__name__}: {error}' for error in likely_errors)])
            self.__cause__ = likely_errors[0]
        super().__init__(text)
