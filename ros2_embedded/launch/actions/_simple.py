# SPDX-License-Identifier: Apache-2.0
"""Actions that say something, call something, or handle events."""
from __future__ import annotations

import asyncio
import collections.abc
import inspect
import logging
from typing import Any, Awaitable, Callable, Dict, Iterable, List, Optional, Tuple

import launch.logging

from .._base import (
    Action,
    BaseEventHandler,
    Entities,
    Event,
    LaunchDescriptionEntity,
    SomeSubstitutionsType,
)
from ..event_handlers import OnShutdown
from ..events import Shutdown as ShutdownEvent
from ..events.process import ProcessExited
from ..frontend.expose import expose_action
from ..launch_context import LaunchContext
from ..utilities import (
    ensure_argument_type,
    is_a_subclass,
    normalize_to_list_of_entities,
    normalize_to_list_of_substitutions,
    perform_substitutions,
)

_logger = logging.getLogger('launch')


class EmitEvent(Action):

    def __init__(self, *, event: Event, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not is_a_subclass(event, Event):
            raise RuntimeError(f"EmitEvent() expected an event instance, got '{event}'.")
        self.event = event

    def execute(self, context: LaunchContext) -> Optional[Entities]:
        context.emit_event_sync(self.event)
        return None


@expose_action('shutdown')
class Shutdown(EmitEvent):

    _texts = {'reason': 'reason?'}

    def __init__(self, *, reason: Any = 'reason not given', **kwargs: Any) -> None:
        super().__init__(event=ShutdownEvent(reason=reason), **kwargs)

    def execute(self, context: LaunchContext) -> Optional[Entities]:
        event = context.get_locals_as_dict().get('event')
        if isinstance(event, ProcessExited):
            _logger.info(
                f'process[{event.process_name}] was required: shutting down launched system')
        return super().execute(context)


@expose_action('log')
class LogInfo(Action):

    _texts = {'msg': 'message'}

    def __init__(self, *, msg: SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.msg = normalize_to_list_of_substitutions(msg)
        self.__logger = launch.logging.get_logger('launch.user')

    def execute(self, context: LaunchContext) -> None:
        self.__logger.info(perform_substitutions(context, self.msg))


class RegisterEventHandler(Action):

    def __init__(self, event_handler: BaseEventHandler, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.event_handler = event_handler

    def execute(self, context: LaunchContext) -> None:
        context.register_event_handler(self.event_handler)

    def describe_conditional_sub_entities(
        self
    ) -> List[Tuple[str, Iterable[LaunchDescriptionEntity]]]:
        text, entities = self.event_handler.describe()
        return [(text, normalize_to_list_of_entities(entities))] if entities else []


class UnregisterEventHandler(Action):

    def __init__(self, event_handler: BaseEventHandler, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.event_handler = event_handler

    def execute(self, context: LaunchContext) -> None:
        context.unregister_event_handler(self.event_handler)


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

    def execute(self, context: LaunchContext) -> Optional[Entities]:
        entities: Optional[Entities] = self.__function(context, *self.__args, **self.__kwargs)
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
        if not inspect.iscoroutinefunction(coroutine):
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
        self.__future = context.asyncio_loop.create_task(self.__coroutine(*args, **self.__kwargs))
        context.register_event_handler(OnShutdown(on_shutdown=self.__on_shutdown))

    def get_asyncio_future(self) -> Optional[asyncio.Future[Any]]:
        return self.__future
