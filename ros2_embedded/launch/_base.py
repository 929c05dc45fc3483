# SPDX-License-Identifier: Apache-2.0
"""What events, substitutions, conditions, event handlers and actions derive from."""
from __future__ import annotations

import asyncio
import collections.abc
import os
import traceback
from typing import Any, Callable, Iterable, Optional, Union

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

    _runs_code = False

    def describe(self) -> str:
        return repr(self)

    def perform(self, context: LaunchContext) -> str:
        raise NotImplementedError('perform() not implemented for Substitution base class.')


SomeSubstitutionsType = Union[str, 'os.PathLike[str]', Substitution, Iterable[
    Union[str, 'os.PathLike[str]', Substitution]]]
SomeSubstitutionsType_types_tuple = (str, os.PathLike, Substitution, collections.abc.Iterable)


class TextSubstitution(Substitution):

    def __init__(self, *, text: str) -> None:
        if not isinstance(text, str):
            raise TypeError(f"TextSubstitution expected Text object got '{type(text)}' instead.")
        self.text = text

    def describe(self) -> str:
        return f"'{self.text}'"

    def perform(self, context: LaunchContext) -> str:
        return self.text


def normalize_to_list_of_substitutions(subs: SomeSubstitutionsType) -> list[Substitution]:
    """
    Return substitutions, texts and paths as TextSubstitution.

    :raises TypeError: for an item that is none of these.
    """
    normalized: list[Substitution] = []
    for item in [subs] if isinstance(subs, (str, os.PathLike, Substitution)) else subs:
        if isinstance(item, (str, os.PathLike)):
            item = TextSubstitution(text=os.fspath(item))
        elif not isinstance(item, Substitution):
            raise TypeError(
                f"Failed to normalize given item of type '{type(item)}', when only 'str', "
                "'pathlib.Path' or 'launch.Substitution' were expected.")
        normalized.append(item)
    return normalized


def perform_substitutions(context: LaunchContext, subs: Iterable[Substitution]) -> str:
    return ''.join([context.perform_substitution(sub) for sub in subs])


class Condition:
    """Decides, when an action is visited, whether it executes."""

    def __init__(self, *, predicate: Callable[[LaunchContext], bool] | None = None) -> None:
        self._predicate = predicate

    def describe(self) -> str:
        return repr(self)

    def evaluate(self, context: LaunchContext) -> bool:
        return False if self._predicate is None else self._predicate(context)


TRUTHS = {'true': True, '1': True, 'false': False, '0': False}


class InvalidConditionExpressionError(ValueError):
    pass


def evaluate_condition_expression(context: LaunchContext, expression: list[Substitution]) -> bool:
    """
    Return what the expression says: 'true' or '1', 'false' or '0', in upper or lower case.

    :raises InvalidConditionExpressionError: for anything else.
    """
    text = perform_substitutions(context, expression).strip().lower()
    if text not in TRUTHS:
        origin = ' + '.join(str(sub) for sub in expression)
        raise InvalidConditionExpressionError(
            f"invalid condition expression, expected one of [{', '.join(TRUTHS)}] "
            f"but got '{text}', expanded from '{origin}'")
    return TRUTHS[text]


class IfCondition(Condition):

    def __init__(self, predicate_expression: SomeSubstitutionsType) -> None:
        self.__predicate_expression = normalize_to_list_of_substitutions(predicate_expression)
        super().__init__(predicate=self._predicate_func)

    def _predicate_func(self, context: LaunchContext) -> bool:
        return evaluate_condition_expression(context, self.__predicate_expression)


class UnlessCondition(IfCondition):

    def _predicate_func(self, context: LaunchContext) -> bool:
        return not super()._predicate_func(context)


class LaunchDescriptionEntity:
    """Something that launch visits, with other entities below it."""

    #: What it is for the search for launch arguments: 'argument', 'include', 'reset' or nothing.
    _role = ''

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
    def parse(cls, entity: Any, parser: Any) -> ParsedAction:
        """
        Return the class and the keyword arguments that a frontend's entity gives.

        :raises RuntimeError: for both ``if`` and ``unless``.
        """
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
    """
    No loader could read a launch file.

    :param likely_errors: the errors of the loaders that were tried.
    """

    def __init__(
        self, *, likely_errors: list[Exception] | None = None, path: str = ''
    ) -> None:
        texts = []
        for error in likely_errors or ():
            line = vars(error).get('line') or ([None] + [
                frame.lineno for frame in traceback.extract_tb(error.__traceback__)
                if frame.filename == path])[-1]
            place = f'{path}, line {line}' if line else path
            # YAML's errors have several lines.
            texts.append(f"{place}: {type(error).__name__}: {' '.join(str(error).split())}")
            self.__cause__ = error
        super().__init__('\n'.join(texts) or (
            'The launch file may have a syntax error, or its format is unknown'))
