# SPDX-License-Identifier: Apache-2.0
"""Actions that contain others: groups, included files, timers."""
from __future__ import annotations

import asyncio
import collections.abc
import os
from typing import Any, cast, Dict, Iterable, List, Optional, Tuple, TYPE_CHECKING, Union
import warnings

import launch.logging

from .._base import (
    Action,
    Entities,
    EventHandler,
    LaunchDescriptionEntity,
    ParsedAction,
    SomeEntitiesType,
    SomeSubstitutionsType,
    SomeSubstitutionsType_types_tuple,
)
from ..events import Shutdown, TimerEvent
from ..frontend.expose import expose_action
from ..launch_context import LaunchContext
from ..launch_description import LaunchDescriptionSource
from ..utilities import (
    ensure_argument_type,
    is_a_subclass,
    normalize_to_list_of_substitutions,
    perform_substitutions,
)
from ..utilities.type_utils import normalize_typed_substitution, perform_typed_substitution
from ._environment import (
    parse_pairs,
    PopEnvironment,
    PopLaunchConfigurations,
    PushEnvironment,
    PushLaunchConfigurations,
    ResetEnvironment,
    ResetLaunchConfigurations,
    SetLaunchConfiguration,
    SomeConfigurations,
)
from ._simple import OpaqueFunction

if TYPE_CHECKING:
    from ..frontend import Entity, Parser

SomeArguments = Iterable[Tuple[SomeSubstitutionsType, SomeSubstitutionsType]]


@expose_action('group')
class GroupAction(Action):
    """
    Actions that belong together.

    :param scoped: whether launch configurations and environment are as before afterwards.
    :param forwarding: whether a scoped group sees the launch configurations and environment
        set outside of it.
    :param launch_configurations: what is set for the group.
    """

    def __init__(
        self, actions: Iterable[Action], *, scoped: bool = True, forwarding: bool = True,
        launch_configurations: Optional[SomeConfigurations] = None, **left_over_kwargs: Any
    ) -> None:
        super().__init__(**left_over_kwargs)
        self.__actions = actions
        self.__scoped = scoped
        self.__forwarding = forwarding
        self.__launch_configurations = launch_configurations or {}
        self.__actions_to_return: Optional[Entities] = None

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        for name in ('scoped', 'forwarding'):
            value = entity.get_attr(name, data_type=bool, optional=True)
            if value is not None:
                kwargs[name] = value
        kwargs['launch_configurations'] = parse_pairs(entity, parser, 'keep')
        kwargs['actions'] = [
            parser.parse_action(child) for child in entity.children
            if child.type_name != 'keep']
        return cls, kwargs

    def get_sub_entities(self) -> Entities:
        if self.__actions_to_return is None:
            entities: Entities = list(self.__actions)
            sets: Entities = [
                SetLaunchConfiguration(name, value)
                for name, value in self.__launch_configurations.items()]
            if self.__scoped and not self.__forwarding:
                sets = [ResetEnvironment(),
                        ResetLaunchConfigurations(self.__launch_configurations)]
            entities = [*sets, *entities]
            if self.__scoped:
                entities = [PushLaunchConfigurations(), PushEnvironment(), *entities,
                            PopEnvironment(), PopLaunchConfigurations()]
            self.__actions_to_return = entities
        return self.__actions_to_return

    def execute(self, context: LaunchContext) -> Optional[Entities]:
        return self.get_sub_entities()


@expose_action('include')
class IncludeLaunchDescription(Action):
    """Sets launch configurations, then visits a launch description from elsewhere."""

    _texts = {'launch_description_source': 'file'}

    def __init__(
        self,
        launch_description_source: Union[LaunchDescriptionSource, SomeSubstitutionsType], *,
        launch_arguments: Optional[SomeArguments] = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        if not isinstance(launch_description_source, LaunchDescriptionSource):
            from ..launch_description_sources import AnyLaunchDescriptionSource
            launch_description_source = AnyLaunchDescriptionSource(launch_description_source)
        self.launch_description_source = launch_description_source
        self.launch_arguments = tuple(launch_arguments or ())
        self.__logger = launch.logging.get_logger(__name__)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['launch_arguments'] = (parse_pairs(entity, parser, 'arg') or {}).items()
        return cls, kwargs

    def _get_launch_file(self) -> str:
        return os.path.abspath(self.launch_description_source.location)

    def _get_launch_file_directory(self) -> str:
        path = self._get_launch_file()
        if os.path.exists(path):
            return os.path.dirname(path)
        return self.launch_description_source.location

    def get_sub_entities(self) -> Entities:
        description = self.launch_description_source.try_get_launch_description_without_context()
        return [] if description is None else [description]

    def __argument_names(self, context: LaunchContext) -> List[str]:
        return [perform_substitutions(context, normalize_to_list_of_substitutions(name))
                for name, _ in self.launch_arguments]

    def _try_get_arguments_names_without_context(self) -> Optional[List[str]]:
        try:
            return self.__argument_names(LaunchContext())
        except Exception as exc:  # noqa: BLE001 - A substitution may raise anything.
            self.__logger.debug(
                'Failed to get launch arguments names for launch description '
                f"'{self.launch_description_source.location}', with exception: {exc}")
        return None

    def execute(self, context: LaunchContext) -> Optional[Entities]:
        description = self.launch_description_source.get_launch_description(context)
        context.extend_locals({
            'current_launch_file_path': self._get_launch_file(),
            'current_launch_file_directory': self._get_launch_file_directory()})
        given = self.__argument_names(context)
        pairs = description.get_launch_arguments_with_include_launch_description_actions()
        for argument, includes in pairs:
            if argument._conditionally_included or argument.default_value is not None:
                continue
            for include in includes or ():
                given.extend(include._try_get_arguments_names_without_context() or ())
            if argument.name not in given:
                raise RuntimeError(
                    'Included launch description missing required argument '
                    f"'{argument.name}' (description: '{argument.description}'), "
                    f"given: [{', '.join(given)}]")
        return [
            *(SetLaunchConfiguration(name, value) for name, value in self.launch_arguments),
            description]


@expose_action('timer')
class TimerAction(Action):
    """Visits actions when a period, in seconds, has passed."""

    def __init__(
        self, *, period: Union[float, SomeSubstitutionsType],
        actions: Iterable[LaunchDescriptionEntity],
        cancel_on_shutdown: Union[bool, SomeSubstitutionsType] = True, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        ensure_argument_type(
            period, (*SomeSubstitutionsType_types_tuple, float), 'period', 'TimerAction')
        ensure_argument_type(actions, collections.abc.Iterable, 'actions', 'TimerAction')
        if isinstance(period, str):
            period = float(period)
            warnings.warn(
                "The parameter 'period' must be a float or substitution,"
                'passing a string literal was deprecated', stacklevel=2)
        self.period = normalize_typed_substitution(period, float)
        self.actions = actions
        self.__context_locals: Dict[str, Any] = {}
        self._completed_future: Optional[asyncio.Future[Any]] = None
        self.__canceled = False
        self._canceled_future: Optional[asyncio.Future[Any]] = None
        self.__cancel_on_shutdown = normalize_typed_substitution(cancel_on_shutdown, bool)
        self.__logger = launch.logging.get_logger(__name__)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['period'] = parser.parse_if_substitutions(
            entity.get_attr('period', data_type=float, can_be_str=True))
        kwargs['actions'] = [parser.parse_action(child) for child in entity.children]
        cancel = entity.get_attr(
            'cancel_on_shutdown', optional=True, data_type=bool, can_be_str=True)
        if cancel is not None:
            kwargs['cancel_on_shutdown'] = parser.parse_if_substitutions(cancel)
        return cls, kwargs

    def describe(self) -> str:
        return f'{type(self).__name__}(period={self.period}, actions=<actions>)'

    def describe_conditional_sub_entities(
        self
    ) -> List[Tuple[str, Iterable[LaunchDescriptionEntity]]]:
        return [(f'{self.period} seconds pass without being canceled', self.actions)]

    async def _wait_to_fire_event(self, context: LaunchContext) -> None:
        assert self._canceled_future is not None and self._completed_future is not None
        await asyncio.wait(
            [self._canceled_future],
            timeout=perform_typed_substitution(context, self.period, float))
        if not self._canceled_future.done():
            await context.emit_event(TimerEvent(timer_action=self))
        self._completed_future.set_result(None)

    def handle(self, context: LaunchContext) -> Optional[SomeEntitiesType]:
        """Return what is to be visited, in the locals of when the timer was started."""
        context.extend_locals(self.__context_locals)
        return self.actions

    def cancel(self) -> None:
        """Cancel the timer, started or not."""
        self.__canceled = True
        if self._canceled_future is not None and not self._canceled_future.done():
            self._canceled_future.set_result(True)

    def execute(self, context: LaunchContext) -> Optional[Entities]:
        self._completed_future = context.asyncio_loop.create_future()
        self._canceled_future = context.asyncio_loop.create_future()
        if self.__canceled:
            self.__logger.debug(
                f'timer {self} not waiting because it was canceled before being executed')
            self._completed_future.set_result(None)
            return None
        if '_TimerAction__event_handler_has_been_installed' not in context.__dict__:
            # One handler does for all timers of a launch.
            context.register_event_handler(EventHandler(
                matcher=lambda event: is_a_subclass(event, TimerEvent),
                entities=OpaqueFunction(function=lambda context: cast(
                    TimerEvent, context.locals.event).timer_action.handle(context))))
            context.__dict__['_TimerAction__event_handler_has_been_installed'] = True
        self.__context_locals = dict(context.get_locals_as_dict())
        context.asyncio_loop.create_task(self._wait_to_fire_event(context))
        if perform_typed_substitution(context, self.__cancel_on_shutdown, bool):
            context.register_event_handler(EventHandler(
                matcher=lambda event: is_a_subclass(event, Shutdown),
                entities=OpaqueFunction(function=lambda context: self.cancel())))
        return None

    def get_asyncio_future(self) -> Optional[asyncio.Future[Any]]:
        return self._completed_future
