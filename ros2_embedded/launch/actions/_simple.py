# SPDX-License-Identifier: Apache-2.0
"""Actions that set something, say something, or call something."""
from __future__ import annotations

import asyncio
import collections.abc
import logging
from typing import Any, Awaitable, Callable, Dict, Iterable, List, Optional, Tuple, TYPE_CHECKING

import launch.logging

from ..action import Action, ParsedAction
from ..event import Event
from ..event_handler import BaseEventHandler
from ..event_handlers import OnShutdown
from ..events import Shutdown as ShutdownEvent
from ..events.process import ProcessExited
from ..frontend.expose import expose_action
from ..launch_context import LaunchContext
from ..launch_description_entity import LaunchDescriptionEntity
from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from ..utilities import (
    ensure_argument_type,
    is_a_subclass,
    normalize_to_list_of_entities,
    normalize_to_list_of_substitutions,
    perform_substitutions,
)

if TYPE_CHECKING:
    from ..frontend import Entity, Parser

_logger = logging.getLogger('launch')


class EmitEvent(Action):
    """Emits an event."""

    def __init__(self, *, event: Event, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not is_a_subclass(event, Event):
            raise RuntimeError(f"EmitEvent() expected an event instance, got '{event}'.")
        self.__event = event

    @property
    def event(self) -> Event:
        """The event."""
        return self.__event

    def execute(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        context.emit_event_sync(self.__event)
        return None


@expose_action('shutdown')
class Shutdown(EmitEvent):
    """Shuts the launch down."""

    def __init__(self, *, reason: Any = 'reason not given', **kwargs: Any) -> None:
        super().__init__(event=ShutdownEvent(reason=reason), **kwargs)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        reason = entity.get_attr('reason', optional=True)
        if reason:
            kwargs['reason'] = parser.parse_substitution(reason)
        return cls, kwargs

    def execute(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        event = context.get_locals_as_dict().get('event')
        if isinstance(event, ProcessExited):
            _logger.info(
                f'process[{event.process_name}] was required: shutting down launched system')
        return super().execute(context)


@expose_action('log')
class LogInfo(Action):
    """Logs a text."""

    def __init__(self, *, msg: SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__msg = normalize_to_list_of_substitutions(msg)
        self.__logger = launch.logging.get_logger('launch.user')

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['msg'] = parser.parse_substitution(entity.get_attr('message'))
        return cls, kwargs

    @property
    def msg(self) -> List[Substitution]:
        """The text."""
        return self.__msg

    def execute(self, context: LaunchContext) -> None:
        self.__logger.info(perform_substitutions(context, self.msg))


class RegisterEventHandler(Action):
    """Adds an event handler."""

    def __init__(self, event_handler: BaseEventHandler, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__event_handler = event_handler

    @property
    def event_handler(self) -> BaseEventHandler:
        """The handler."""
        return self.__event_handler

    def execute(self, context: LaunchContext) -> None:
        context.register_event_handler(self.__event_handler)

    def describe_conditional_sub_entities(
        self
    ) -> List[Tuple[str, Iterable[LaunchDescriptionEntity]]]:
        text, entities = self.__event_handler.describe()
        return [(text, normalize_to_list_of_entities(entities))] if entities else []


class UnregisterEventHandler(Action):
    """Removes an event handler."""

    def __init__(self, event_handler: BaseEventHandler, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__event_handler = event_handler

    @property
    def event_handler(self) -> BaseEventHandler:
        """The handler."""
        return self.__event_handler

    def execute(self, context: LaunchContext) -> None:
        context.unregister_event_handler(self.__event_handler)


class OpaqueFunction(Action):
    """
    Calls ``function(context, *args, **kwargs)`` and visits the entities it returns.

    :raises TypeError: for a ``function`` that can't be called, and other wrong arguments.
    """

    def __init__(
        self, *, function: Callable[..., Any], args: Optional[Iterable[Any]] = None,
        kwargs: Optional[Dict[str, Any]] = None, **left_over_kwargs: Any
    ) -> None:
        super().__init__(**left_over_kwargs)
        if not callable(function):
            raise TypeError(
                f"OpaqueFunction expected a callable for 'function', got '{type(function)}'")
        ensure_argument_type(
            args, (collections.abc.Iterable, type(None)), 'args', 'OpaqueFunction')
        ensure_argument_type(kwargs, (dict, type(None)), 'kwargs', 'OpaqueFunction')
        self.__function = function
        self.__args = args or ()
        self.__kwargs = kwargs or {}

    def execute(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        entities: Optional[List[LaunchDescriptionEntity]] = self.__function(
            context, *self.__args, **self.__kwargs)
        return entities


class OpaqueCoroutine(Action):
    """
    Runs ``coroutine(context, *args, **kwargs)`` in launch's loop; a shutdown cancels it.

    :param ignore_context: whether to call the coroutine without the context.
    :raises TypeError: for a ``coroutine`` that isn't a coroutine function, and other wrong
        arguments.
    """

    def __init__(
        self, *, coroutine: Callable[..., Awaitable[None]],
        args: Optional[Iterable[Any]] = None, kwargs: Optional[Dict[str, Any]] = None,
        ignore_context: bool = False, **left_over_kwargs: Any
    ) -> None:
        super().__init__(**left_over_kwargs)
        if not asyncio.iscoroutinefunction(coroutine):
            raise TypeError(
                "OpaqueCoroutine expected a coroutine function for 'coroutine', "
                f"got '{type(coroutine)}'")
        ensure_argument_type(
            args, (collections.abc.Iterable, type(None)), 'args', 'OpaqueCoroutine')
        ensure_argument_type(kwargs, (dict, type(None)), 'kwargs', 'OpaqueCoroutine')
        ensure_argument_type(ignore_context, bool, 'ignore_context', 'OpaqueCoroutine')
        self.__coroutine = coroutine
        self.__args = args or ()
        self.__kwargs = kwargs or {}
        self.__ignore_context = ignore_context
        self.__future: Optional[asyncio.Future[Any]] = None

    def __on_shutdown(self, event: Event, context: LaunchContext) -> None:
        if self.__future is not None:
            self.__future.cancel()

    def execute(self, context: LaunchContext) -> None:
        args = self.__args if self.__ignore_context else (context, *self.__args)
        self.__future = context.asyncio_loop.create_task(
            self.__coroutine(*args, **self.__kwargs))
        context.register_event_handler(OnShutdown(on_shutdown=self.__on_shutdown))

    def get_asyncio_future(self) -> Optional[asyncio.Future[Any]]:
        return self.__future
