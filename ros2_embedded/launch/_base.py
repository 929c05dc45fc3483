# SPDX-License-Identifier: Apache-2.0
"""What events, substitutions, conditions, event handlers and actions derive from."""
from __future__ import annotations

import asyncio
import collections.abc
import os
from typing import Any, Callable, Iterable, Optional, TYPE_CHECKING, Union

if TYPE_CHECKING:
    from .frontend import Entity, Parser
    from .launch_context import LaunchContext

__all__ = [
    'Action', 'BaseEventHandler', 'Condition', 'Event', 'EventHandler', 'InvalidLaunchFileError',
    'LaunchDescriptionEntity', 'SomeEntitiesType', 'SomeEntitiesType_types_tuple',
    'SomeSubstitutionsType', 'SomeSubstitutionsType_types_tuple', 'Substitution']


class Event:
    """Something that happened, or is to happen; its class's path is its name."""

    name = 'launch.Event'

    def __init_subclass__(cls) -> None:
        if 'name' not in vars(cls):
            cls.name = f'{cls.__module__}.{cls.__name__}'


class Substitution:
    """A text that is only known when the launch runs."""

    def describe(self) -> str:
        return repr(self)

    def perform(self, context: LaunchContext) -> str:
        raise NotImplementedError('perform() not implemented for Substitution base class.')


SomeSubstitutionsType = Union[str, 'os.PathLike[str]', Substitution, Iterable[
    Union[str, 'os.PathLike[str]', Substitution]]]
SomeSubstitutionsType_types_tuple = (str, os.PathLike, Substitution, collections.abc.Iterable)


class Condition:
    """Decides, when an action is visited, whether it executes."""

    def __init__(self, *, predicate: Callable[[LaunchContext], bool] | None = None) -> None:
        self._predicate = predicate

    def describe(self) -> str:
        return repr(self)

    def evaluate(self, context: LaunchContext) -> bool:
        return False if self._predicate is None else self._predicate(context)


class LaunchDescriptionEntity:
    """Something that launch visits, with other entities below it."""

    def describe(self) -> str:
        return repr(self)

    def describe_sub_entities(self) -> list[LaunchDescriptionEntity]:
        return []

    def describe_conditional_sub_entities(self) -> Conditional:
        return []

    def visit(self, context: LaunchContext) -> list[LaunchDescriptionEntity] | None:
        """Do the entity's work; return what is to be visited next, in order."""
        return None

    def get_asyncio_future(self) -> asyncio.Future[Any] | None:
        """Return what launch waits for before it is idle."""
        return None


Entities = list[LaunchDescriptionEntity]
Conditional = list[tuple[str, Iterable[LaunchDescriptionEntity]]]
SomeEntitiesType = Union[LaunchDescriptionEntity, Iterable[LaunchDescriptionEntity]]
SomeEntitiesType_types_tuple = (LaunchDescriptionEntity, collections.abc.Iterable)


class BaseEventHandler:
    """Answers the events that the matcher picks; ``handle_once``: only the first of them."""

    def __init__(self, *, matcher: Callable[[Event], bool], handle_once: bool = False) -> None:
        self.__matcher = matcher
        self.handle_once = handle_once

    def matches(self, event: Event) -> bool:
        return self.__matcher(event)

    def describe(self) -> tuple[str, list[Any]]:
        """Return a text for humans, and the entities that the handler may return."""
        return f'{type(self).__name__}(handle_once={self.handle_once})', []

    def handle(self, event: Event, context: LaunchContext) -> SomeEntitiesType | None:
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
        self.entities = entities

    def describe(self) -> tuple[str, list[Any]]:
        entities = self.entities or ()
        return super().describe()[0], [
            entities] if isinstance(entities, LaunchDescriptionEntity) else [*entities]

    def handle(self, event: Event, context: LaunchContext) -> SomeEntitiesType | None:
        super().handle(event, context)
        return self.entities


ParsedAction = tuple[type['Action'], dict[str, Any]]


class Action(LaunchDescriptionEntity):
    """An entity that does something, if the condition holds."""

    #: For :meth:`parse`: arguments that are texts with substitutions, and their attributes in
    #: launch files; a question mark where they may be absent.
    _texts: dict[str, str] = {}
    #: Likewise, arguments of other types, which may be absent.
    _typed: dict[str, type] = {}

    def __init__(self, *, condition: Condition | None = None) -> None:
        self.__condition = condition

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        """
        Return the class and the keyword arguments that a frontend's entity gives.

        :raises RuntimeError: for both ``if`` and ``unless``.
        """
        from .conditions import IfCondition, UnlessCondition
        kwargs: dict[str, Any] = {}
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
        for argument, data_type in cls._typed.items():
            value = entity.get_attr(argument, data_type=data_type, optional=True)
            if value is not None:
                kwargs[argument] = parser.parse_if_substitutions(value)
        return cls, kwargs

    @property
    def condition(self) -> Condition | None:
        return self.__condition

    def get_sub_entities(self) -> Entities:
        """Return what executing the action yields, as far as it is known before."""
        return []

    def describe_sub_entities(self) -> Entities:
        return self.get_sub_entities() if self.condition is None else []

    def describe_conditional_sub_entities(self) -> Conditional:
        if self.condition is None:
            return []
        return [(f'Conditionally included by {self.describe()}', self.get_sub_entities())]

    def visit(self, context: LaunchContext) -> Entities | None:
        """Execute if the condition holds."""
        if self.__condition is not None and not self.__condition.evaluate(context):
            return None
        return self.execute(context)

    def execute(self, context: LaunchContext) -> Entities | None:
        """Do the action's work, without blocking; return what is to be visited next."""
        return None


class InvalidLaunchFileError(Exception):
    """No loader could read a launch file; the first of their errors is the likeliest."""

    def __init__(
        self, extension: str = '', *, likely_errors: list[Exception] | None = None
    ) -> None:
        text = 'The launch file may have a syntax error, or its format is unknown'
        if extension and likely_errors:
            kind = 'multiple exceptions' if len(likely_errors) > 1 else 'exception'
            text = '\n - '.join([
                f'Caught {kind} when trying to load file of format [{extension}]:',
                *(f'{type(error).__name__}: {error}' for error in likely_errors)])
            self.__cause__ = likely_errors[0]
        super().__init__(text)
