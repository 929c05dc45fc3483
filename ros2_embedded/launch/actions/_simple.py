# SPDX-License-Identifier: Apache-2.0
"""Actions that say something, call something, or handle events."""
from __future__ import annotations

import logging
from typing import Any, Callable, Iterable

import launch.logging

from .._base import (
    Action,
    BaseEventHandler,
    Conditional,
    Entities,
    Event,
    SomeSubstitutionsType,
)
from ..events import Shutdown as ShutdownEvent
from ..events.process import ProcessExited
from ..frontend.expose import expose_action
from ..launch_context import LaunchContext
from ..utilities import (
    is_a_subclass,
    normalize_to_list_of_entities,
    normalize_to_list_of_substitutions,
    perform_substitutions,
)

__all__ = ['EmitEvent', 'LogInfo', 'OpaqueFunction', 'RegisterEventHandler', 'Shutdown']

_logger = logging.getLogger('launch')


class EmitEvent(Action):

    def __init__(self, *, event: Event, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not is_a_subclass(event, Event):
            raise RuntimeError(f"EmitEvent() expected an event instance, got '{event}'.")
        self.event = event

    def execute(self, context: LaunchContext) -> Entities | None:
        context.emit_event_sync(self.event)
        return None


@expose_action('shutdown')
class Shutdown(EmitEvent):

    _texts = {'reason': 'reason?'}

    def __init__(self, *, reason: Any = 'reason not given', **kwargs: Any) -> None:
        super().__init__(event=ShutdownEvent(reason=reason), **kwargs)

    def execute(self, context: LaunchContext) -> Entities | None:
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

    def describe_conditional_sub_entities(self) -> Conditional:
        text, entities = self.event_handler.describe()
        return [(text, normalize_to_list_of_entities(entities))] if entities else []


class OpaqueFunction(Action):
    """Calls ``function(context, *args, **kwargs)`` and visits the entities it returns."""

    def __init__(
        self, *, function: Callable[..., Any], args: Iterable[Any] | None = None,
        kwargs: dict[str, Any] | None = None, **left_over_kwargs: Any
    ) -> None:
        super().__init__(**left_over_kwargs)
        if not callable(function):
            raise TypeError(
                f"OpaqueFunction expected a callable for 'function', got '{type(function)}'")
        self.__function = function
        self.__args = args or ()
        self.__kwargs = kwargs or {}

    def execute(self, context: LaunchContext) -> Entities | None:
        entities: Entities | None = self.__function(context, *self.__args, **self.__kwargs)
        return entities
