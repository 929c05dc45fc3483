# SPDX-License-Identifier: Apache-2.0
"""Handlers of launch's own events."""
from __future__ import annotations

import collections.abc
from typing import Any, Callable

from embedded_default.lacking import lacking

from .. import _base
from ..events import IncludeLaunchDescription, Shutdown
from ..events.process import ProcessAction, ProcessExited, ProcessIO, ProcessStarted
from ..launch_context import LaunchContext
from ..utilities import is_a_subclass

__getattr__ = lacking(__name__, 'OnExecutionComplete')

SomeTarget = Callable[[Any], bool] | _base.Action | None
#: Entities to be visited, or what returns some for an event and the context.
SomeReaction = _base.SomeEntitiesType | Callable[[Any, Any], _base.SomeEntitiesType | None] | None
OnOutput = Callable[[ProcessIO], _base.SomeEntitiesType | None] | None


def event_named(name: str) -> Callable[[_base.Event], bool]:
    return lambda event: event.name == name


class OnActionEventBase(_base.BaseEventHandler):
    """
    Answers events that concern an action.

    :param action_matcher: the action, or what says of an action whether it is meant.
    :param on_event: entities, or a callable that returns some for event and context.
    :raises TypeError: for an ``action_matcher`` of another class, or items of ``on_event``
        that aren't entities.
    """

    def __init__(
        self, *, action_matcher: SomeTarget, on_event: Any, target_event_cls: type[_base.Event],
        target_action_cls: type[_base.Action], **kwargs: Any
    ) -> None:
        is_action = isinstance(action_matcher, target_action_cls)
        if not is_action and action_matcher is not None and not callable(action_matcher):
            raise TypeError(f"action_matcher must be an '{target_action_cls.__name__}' instance "
                            'or a callable')

        def matches(event: _base.Event) -> bool:
            if not isinstance(event, target_event_cls):
                return False
            action: _base.Action = event.action  # type: ignore[attr-defined]
            if callable(action_matcher):
                return bool(action_matcher(action))
            return action_matcher is None or action is action_matcher

        super().__init__(matcher=matches, **kwargs)
        self.__on_event = on_event if callable(on_event) else None
        self.__entities: _base.Entities = []
        if isinstance(on_event, collections.abc.Iterable):
            self.__entities = list(on_event)
        elif self.__on_event is None and on_event is not None:
            self.__entities = [on_event]
        for entity in self.__entities:
            if not isinstance(entity, _base.LaunchDescriptionEntity):
                raise TypeError("expected all items in 'on_event' iterable to be of type "
                                f"'LaunchDescriptionEntity' but got '{type(entity)}'")

    def handle(self, event: _base.Event, context: LaunchContext) -> _base.SomeEntitiesType | None:
        super().handle(event, context)
        if self.__on_event is not None:
            entities: _base.SomeEntitiesType | None = self.__on_event(event, context)
            return entities
        return self.__entities

    def describe(self) -> tuple[str, list[Any]]:
        return super().describe()[0], [*self.__entities]


class OnProcessExit(OnActionEventBase):

    def __init__(
        self, *, target_action: SomeTarget = None, on_exit: SomeReaction, **kwargs: Any
    ) -> None:
        super().__init__(
            action_matcher=target_action, on_event=on_exit,
            target_event_cls=ProcessExited, target_action_cls=ProcessAction, **kwargs)


class OnProcessIO(OnActionEventBase):

    def __init__(
        self, *, target_action: SomeTarget = None, on_stdin: OnOutput = None,
        on_stdout: OnOutput = None, on_stderr: OnOutput = None, **kwargs: Any
    ) -> None:
        def handle(event: ProcessIO, _: LaunchContext) -> _base.SomeEntitiesType | None:
            handler = (
                on_stdout if event.from_stdout else on_stderr if event.from_stderr else on_stdin)
            return None if handler is None else handler(event)

        super().__init__(
            action_matcher=target_action, on_event=handle,
            target_event_cls=ProcessIO, target_action_cls=ProcessAction, **kwargs)


class OnProcessStart(OnActionEventBase):

    def __init__(
        self, *, target_action: SomeTarget = None, on_start: SomeReaction, **kwargs: Any
    ) -> None:
        super().__init__(
            action_matcher=target_action, on_event=on_start,
            target_event_cls=ProcessStarted, target_action_cls=ProcessAction, **kwargs)


class OnIncludeLaunchDescription(_base.BaseEventHandler):
    """Visits what IncludeLaunchDescription events carry."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            matcher=lambda event: is_a_subclass(event, IncludeLaunchDescription), **kwargs)

    def handle(self, event: Any, context: LaunchContext) -> _base.SomeEntitiesType | None:
        super().handle(event, context)
        return [event.launch_description]


class OnShutdown(_base.BaseEventHandler):

    def __init__(self, *, on_shutdown: SomeReaction, **kwargs: Any) -> None:
        super().__init__(matcher=lambda event: is_a_subclass(event, Shutdown), **kwargs)
        self.__on_shutdown = on_shutdown

    def handle(self, event: _base.Event, context: LaunchContext) -> _base.SomeEntitiesType | None:
        super().handle(event, context)
        if callable(self.__on_shutdown):
            return self.__on_shutdown(event, context)
        return self.__on_shutdown
