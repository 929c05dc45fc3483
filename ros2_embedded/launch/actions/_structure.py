# SPDX-License-Identifier: Apache-2.0
"""Actions that contain others: groups, included files, timers."""
from __future__ import annotations

import asyncio
import collections.abc
import os
from typing import Any, Iterable, TYPE_CHECKING

import launch.logging

from .. import _base
from ..event_handlers import OnShutdown
from ..events import TimerEvent
from ..frontend.expose import expose_action
from ..launch_context import LaunchContext
from ..launch_description import LaunchDescriptionSource
from ..launch_description_sources import AnyLaunchDescriptionSource
from ..utilities import ensure_argument_type, perform_substitutions
from ..utilities import normalize_to_list_of_substitutions as normalize
from ..utilities.type_utils import normalize_typed_substitution, perform_typed_substitution
from . import _simple as simple

if TYPE_CHECKING:
    from ..frontend import Entity, Parser

__all__ = ['GroupAction', 'IncludeLaunchDescription', 'TimerAction']


@expose_action('group')
class GroupAction(_base.Action):
    """
    Actions that belong together.

    :param scoped: whether launch configurations and environment are as before afterwards.
    :param forwarding: whether a scoped group sees the launch configurations and environment
        set outside of it.
    :param launch_configurations: what is set for the group.
    """

    _typed = {'scoped': bool, 'forwarding': bool}

    def __init__(
        self, actions: Iterable[_base.Action], *, scoped: bool = True, forwarding: bool = True,
        launch_configurations: dict[Any, Any] | None = None, **left_over_kwargs: Any
    ) -> None:
        super().__init__(**left_over_kwargs)
        self.__actions = actions
        self.__scoped = scoped
        self.__forwarding = forwarding
        self.__launch_configurations = launch_configurations or {}
        self.__actions_to_return: _base.Entities | None = None

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> _base.ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['launch_configurations'] = simple.parse_pairs(entity, parser, 'keep')
        kwargs['actions'] = [
            parser.parse_action(child) for child in entity.children
            if child.type_name != 'keep']
        return cls, kwargs

    def get_sub_entities(self) -> _base.Entities:
        if self.__actions_to_return is None:
            kept = self.__launch_configurations
            before: _base.Entities = [
                simple.SetLaunchConfiguration(*pair) for pair in kept.items()]
            after: _base.Entities = []
            if self.__scoped:
                if not self.__forwarding:
                    before = [simple.ResetEnvironment(),
                              simple.ResetLaunchConfigurations(kept)]
                before = [simple.PushLaunchConfigurations(), simple.PushEnvironment(),
                          *before]
                after = [simple.PopEnvironment(), simple.PopLaunchConfigurations()]
            self.__actions_to_return = [*before, *self.__actions, *after]
        return self.__actions_to_return

    def execute(self, context: LaunchContext) -> _base.Entities | None:
        return self.get_sub_entities()


@expose_action('include')
class IncludeLaunchDescription(_base.Action):
    """Sets launch configurations, then visits a launch description from elsewhere."""

    _role = 'include'
    _texts = {'launch_description_source': 'file'}

    def __init__(
        self,
        launch_description_source: LaunchDescriptionSource | _base.SomeSubstitutionsType, *,
        launch_arguments: Iterable[tuple[Any, Any]] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        if not isinstance(launch_description_source, LaunchDescriptionSource):
            launch_description_source = AnyLaunchDescriptionSource(launch_description_source)
        self.launch_description_source = launch_description_source
        self.launch_arguments = tuple(launch_arguments or ())
        self.__logger = launch.logging.get_logger(__name__)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> _base.ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['launch_arguments'] = [
            pair for element in ('arg', 'let')
            for pair in (simple.parse_pairs(entity, parser, element) or {}).items()]
        return cls, kwargs

    def get_sub_entities(self) -> _base.Entities:
        description = self.launch_description_source.try_get_launch_description_without_context()
        return [] if description is None else [description]

    def __argument_names(self, context: LaunchContext) -> list[str]:
        return [perform_substitutions(context, normalize(name))
                for name, _ in self.launch_arguments]

    def _argument_names_without_context(self) -> list[str]:
        try:
            return self.__argument_names(LaunchContext())
        except Exception as exc:  # noqa: BLE001 - A substitution may raise anything.
            self.__logger.debug(f'No names of launch arguments without a context: {exc}')
        return []

    def execute(self, context: LaunchContext) -> _base.Entities | None:
        source = self.launch_description_source
        description = source.get_launch_description(context)
        path = os.path.abspath(source.location)
        directory = os.path.dirname(path) if os.path.exists(path) else source.location
        context.extend_locals({
            'current_launch_file_path': path, 'current_launch_file_directory': directory})
        given = self.__argument_names(context)
        pairs = description.get_launch_arguments_with_include_launch_description_actions()
        for argument, includes in pairs:
            if argument._conditionally_included or argument.default_value is not None:
                continue
            for include in includes:
                given += include._argument_names_without_context()
            if argument.name not in given:
                raise RuntimeError(
                    'Included launch description missing required argument '
                    f"'{argument.name}' (description: '{argument.description}'), "
                    f"given: [{', '.join(given)}]")
        return [*(simple.SetLaunchConfiguration(*pair) for pair in self.launch_arguments),
                description]


@expose_action('timer')
class TimerAction(_base.Action):
    """Visits actions when a period, in seconds, has passed."""

    _typed = {'period': float, 'cancel_on_shutdown': bool}

    def __init__(
        self, *, period: float | _base.SomeSubstitutionsType,
        actions: Iterable[_base.LaunchDescriptionEntity],
        cancel_on_shutdown: bool | _base.SomeSubstitutionsType = True, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        ensure_argument_type(actions, collections.abc.Iterable, 'actions', 'TimerAction')
        self.period = normalize_typed_substitution(period, float)
        self.actions = actions
        self.__seconds = 0.0
        self.__locals: dict[str, Any] = {}
        self.__configurations: dict[str, Any] = {}
        self._completed_future: asyncio.Future[Any] | None = None
        self.__canceled = False
        self._canceled_future: asyncio.Future[Any] | None = None
        self.__cancel_on_shutdown = normalize_typed_substitution(cancel_on_shutdown, bool)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> _base.ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['actions'] = [parser.parse_action(child) for child in entity.children]
        return cls, kwargs

    def describe_conditional_sub_entities(self) -> _base.Conditional:
        return [(f'{self.period} seconds pass without being canceled', self.actions)]

    async def _wait_to_fire_event(self, context: LaunchContext) -> None:
        assert self._canceled_future is not None and self._completed_future is not None
        await asyncio.wait([self._canceled_future], timeout=self.__seconds)
        if not self._canceled_future.done():
            await context.emit_event(TimerEvent(timer_action=self))
        self._completed_future.set_result(None)

    def handle(self, context: LaunchContext) -> _base.SomeEntitiesType | None:
        """Return the actions, in the locals and launch configurations of the timer's start."""
        context.extend_locals(self.__locals)
        return [simple.PushLaunchConfigurations(),
                simple.OpaqueFunction(function=self.__set_configurations),
                *self.actions, simple.PopLaunchConfigurations()]

    def __set_configurations(self, context: LaunchContext) -> None:
        context.launch_configurations = dict(self.__configurations)

    def cancel(self) -> None:
        """Cancel the timer, started or not."""
        self.__canceled = True
        if self._canceled_future is not None and not self._canceled_future.done():
            self._canceled_future.set_result(True)

    def execute(self, context: LaunchContext) -> _base.Entities | None:
        self._completed_future = context.asyncio_loop.create_future()
        self._canceled_future = context.asyncio_loop.create_future()
        if self.__canceled:
            self._completed_future.set_result(None)
            return None
        if '_TimerAction__event_handler_has_been_installed' not in vars(context):
            # One handler does for all timers of a launch.
            context.register_event_handler(_base.EventHandler(
                matcher=lambda event: isinstance(event, TimerEvent),
                entities=simple.OpaqueFunction(
                    function=lambda context: context.locals.event.timer_action.handle(context))))
            vars(context)['_TimerAction__event_handler_has_been_installed'] = True
        self.__seconds = perform_typed_substitution(context, self.period, float)
        self.__locals = context.get_locals_as_dict()
        # Lists grow in place: namespace, remappings and parameters of launch_ros.
        self.__configurations = {
            name: list(value) if isinstance(value, list) else value
            for name, value in context.launch_configurations.items()}
        context.asyncio_loop.create_task(self._wait_to_fire_event(context))
        if perform_typed_substitution(context, self.__cancel_on_shutdown, bool):
            context.register_event_handler(
                OnShutdown(on_shutdown=lambda event, context: self.cancel()))
        return None

    def get_asyncio_future(self) -> asyncio.Future[Any] | None:
        return self._completed_future
