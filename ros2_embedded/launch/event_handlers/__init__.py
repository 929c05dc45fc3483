# SPDX-License-Identifier: Apache-2.0
"""Handlers of launch's own events."""
from __future__ import annotations

import collections.abc
from typing import Any, Callable, cast, List, Optional, Tuple, Type, TYPE_CHECKING, Union

from .._aliases import alias_submodules
from ..event import Event
from ..event_handler import BaseEventHandler, EventHandler
from ..events import ExecutionComplete, IncludeLaunchDescription, Shutdown
from ..events.process import ProcessExited, ProcessIO, ProcessStarted
from ..launch_description_entity import LaunchDescriptionEntity
from ..some_entities_type import SomeEntitiesType
from ..utilities import is_a_subclass

if TYPE_CHECKING:
    from ..action import Action
    from ..actions import ExecuteLocal
    from ..launch_context import LaunchContext

__all__ = [
    'event_named',
    'OnExecutionComplete',
    'OnIncludeLaunchDescription',
    'OnProcessExit',
    'OnProcessIO',
    'OnProcessStart',
    'OnShutdown',
]

SomeTarget = Optional[Union[Callable[[Any], bool], 'Action']]


def event_named(name: str) -> Callable[[Event], bool]:
    """Return a matcher for events of that name."""
    return lambda event: event.name == name


class OnActionEventBase(BaseEventHandler):
    """
    Answers events that concern an action.

    :param action_matcher: the action, or what says of an action whether it is meant.
    :param on_event: entities, or a callable that returns some for event and context.
    :raises TypeError: for an ``action_matcher`` of another class, or items of ``on_event``
        that aren't entities.
    """

    def __init__(
        self, *, action_matcher: SomeTarget, on_event: Any, target_event_cls: Type[Event],
        target_action_cls: Type[Action], **kwargs: Any
    ) -> None:
        if not issubclass(target_event_cls, Event):
            raise TypeError("'target_event_cls' must be a subclass of 'Event'")
        is_action = isinstance(action_matcher, target_action_cls)
        if not is_action and action_matcher is not None and not callable(action_matcher):
            raise TypeError(
                f"action_matcher must be an '{target_action_cls.__name__}' instance "
                'or a callable')
        self.__action_matcher = action_matcher
        self.__event_name = target_event_cls.__name__
        self.__action_name = target_action_cls.__name__

        def matches(event: Event) -> bool:
            if not isinstance(event, target_event_cls):
                return False
            action: Action = event.action  # type: ignore[attr-defined]
            if callable(action_matcher):
                return bool(action_matcher(action))
            return action_matcher is None or action is action_matcher

        super().__init__(matcher=matches, **kwargs)
        self.__entities: List[LaunchDescriptionEntity] = []
        self.__on_event: Optional[Callable[[Event, LaunchContext], Any]] = None
        if callable(on_event):
            self.__on_event = on_event
        elif isinstance(on_event, collections.abc.Iterable):
            self.__entities = list(on_event)
            for entity in self.__entities:
                if not isinstance(entity, LaunchDescriptionEntity):
                    raise TypeError(
                        "expected all items in 'on_event' iterable to be of type "
                        f"'LaunchDescriptionEntity' but got '{type(entity)}'")
        elif on_event is not None:
            self.__entities = [on_event]

    def handle(self, event: Event, context: LaunchContext) -> Optional[SomeEntitiesType]:
        super().handle(event, context)
        if self.__on_event is not None:
            return cast(Optional[SomeEntitiesType], self.__on_event(event, context))
        return self.__entities

    def describe(self) -> Tuple[str, List[Any]]:
        text, entities = super().describe()
        return text, [*entities, *self.__entities]

    @property
    def handler_description(self) -> str:
        return '<actions>' if self.__entities else str(self.__on_event)

    @property
    def matcher_description(self) -> str:
        text = f'event == {self.__event_name}'
        if self.__action_matcher is not None:
            text += f' and {self.__action_name}(event.action)'
        return text


class OnExecutionComplete(OnActionEventBase):
    """Answers the completion of actions."""

    def __init__(
        self, *, target_action: SomeTarget = None,
        on_completion: Union[
            SomeEntitiesType,
            Callable[[ExecutionComplete, LaunchContext], Optional[SomeEntitiesType]]],
        **kwargs: Any
    ) -> None:
        from ..action import Action
        super().__init__(
            action_matcher=target_action, on_event=on_completion,
            target_event_cls=ExecutionComplete, target_action_cls=Action, **kwargs)


class OnProcessExit(OnActionEventBase):
    """Answers the end of processes."""

    def __init__(
        self, *,
        target_action: Optional[Union[Callable[[ExecuteLocal], bool], ExecuteLocal]] = None,
        on_exit: Union[
            SomeEntitiesType,
            Callable[[ProcessExited, LaunchContext], Optional[SomeEntitiesType]], None],
        **kwargs: Any
    ) -> None:
        from ..actions import ExecuteLocal
        super().__init__(
            action_matcher=target_action, on_event=on_exit,
            target_event_cls=ProcessExited, target_action_cls=ExecuteLocal, **kwargs)


OnOutput = Optional[Callable[[ProcessIO], Optional[SomeEntitiesType]]]


class OnProcessIO(OnActionEventBase):
    """Answers input and output of processes."""

    def __init__(
        self, *, target_action: SomeTarget = None, on_stdin: OnOutput = None,
        on_stdout: OnOutput = None, on_stderr: OnOutput = None, **kwargs: Any
    ) -> None:
        from ..actions import ExecuteLocal

        def handle(event: ProcessIO, _: LaunchContext) -> Optional[SomeEntitiesType]:
            for wanted, handler in (
                (event.from_stdout, on_stdout), (event.from_stderr, on_stderr),
                (event.from_stdin, on_stdin)
            ):
                if wanted and handler is not None:
                    return handler(event)
            return None

        super().__init__(
            action_matcher=target_action, on_event=handle,
            target_event_cls=ProcessIO, target_action_cls=ExecuteLocal, **kwargs)


class OnProcessStart(OnActionEventBase):
    """Answers the start of processes."""

    def __init__(
        self, *, target_action: SomeTarget = None,
        on_start: Union[
            SomeEntitiesType,
            Callable[[ProcessStarted, LaunchContext], Optional[SomeEntitiesType]]],
        **kwargs: Any
    ) -> None:
        from ..actions import ExecuteProcess
        super().__init__(
            action_matcher=target_action, on_event=on_start,
            target_event_cls=ProcessStarted, target_action_cls=ExecuteProcess, **kwargs)


class OnIncludeLaunchDescription(EventHandler):
    """Visits what IncludeLaunchDescription events carry."""

    def __init__(self, **kwargs: Any) -> None:
        from ..actions import OpaqueFunction
        super().__init__(
            matcher=lambda event: is_a_subclass(event, IncludeLaunchDescription),
            entities=OpaqueFunction(
                function=lambda context: [context.locals.event.launch_description]),
            **kwargs)

    @property
    def handler_description(self) -> str:
        return 'returns the launch_description in the event'

    @property
    def matcher_description(self) -> str:
        return 'event issubclass of launch.events.IncludeLaunchDescription'


class OnShutdown(BaseEventHandler):
    """Answers the launch's shutdown."""

    def __init__(
        self, *,
        on_shutdown: Union[
            SomeEntitiesType, Callable[[Shutdown, LaunchContext], Optional[SomeEntitiesType]]],
        **kwargs: Any
    ) -> None:
        super().__init__(matcher=lambda event: is_a_subclass(event, Shutdown), **kwargs)
        self.__on_shutdown = on_shutdown

    def handle(self, event: Event, context: LaunchContext) -> Optional[SomeEntitiesType]:
        super().handle(event, context)
        if callable(self.__on_shutdown):
            return self.__on_shutdown(cast(Shutdown, event), context)
        return self.__on_shutdown

    @property
    def handler_description(self) -> str:
        return str(self.__on_shutdown)

    @property
    def matcher_description(self) -> str:
        return 'event issubclass of launch.events.Shutdown'


alias_submodules(__name__, __all__[1:], {
    'on_action_event_base': ('OnActionEventBase',)})
