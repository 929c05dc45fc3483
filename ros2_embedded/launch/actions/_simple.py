# SPDX-License-Identifier: Apache-2.0
"""Actions that set, say or call something, or handle events."""
from __future__ import annotations

import logging
import os
from typing import Any, Callable, Iterable, List, TYPE_CHECKING

import launch.logging

from .. import _base
from ..events import Shutdown as ShutdownEvent
from ..events.process import ProcessExited
from ..frontend.expose import expose_action
from ..frontend.type_utils import Entity
from ..launch_context import LaunchContext
from ..utilities import is_a_subclass, normalize_to_list_of_entities, perform_substitutions
from ..utilities import normalize_to_list_of_substitutions as normalize
from ..utilities.type_utils import normalize_typed_substitution, perform_typed_substitution

if TYPE_CHECKING:
    from ..frontend import Parser

__all__ = [
    'AppendEnvironmentVariable', 'DeclareLaunchArgument', 'EmitEvent', 'LogInfo',
    'OpaqueFunction', 'PopEnvironment', 'PopLaunchConfigurations', 'PushEnvironment',
    'PushLaunchConfigurations', 'RegisterEventHandler', 'ResetEnvironment',
    'ResetLaunchConfigurations', 'SetEnvironmentVariable', 'SetLaunchConfiguration', 'Shutdown',
    'UnsetEnvironmentVariable', 'UnsetLaunchConfiguration']

_logger = logging.getLogger('launch')


def parse_pairs(
    entity: Entity, parser: Parser, element: str, key: str = 'name', value: str = 'value'
) -> dict[Any, Any] | None:
    """Return what nested elements give by name, None if there are none of that kind."""
    nested = entity.get_attr(element, data_type=List[Entity], optional=True)
    if nested is None:
        return None
    pairs = {tuple(parser.parse_substitution(one.get_attr(key))):
             parser.parse_substitution(one.get_attr(value)) for one in nested}
    for one in nested:
        one.assert_entity_completely_parsed()
    return pairs


class _Named(_base.Action):

    _texts = {'name': 'name'}

    def __init__(self, name: _base.SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.name = normalize(name)


class _NamedValue(_Named):

    _texts = {'name': 'name', 'value': 'value'}

    def __init__(
        self, name: _base.SomeSubstitutionsType, value: _base.SomeSubstitutionsType, **kwargs: Any
    ) -> None:
        super().__init__(name, **kwargs)
        self.value = normalize(value)


@expose_action('set_env')
class SetEnvironmentVariable(_NamedValue):

    def execute(self, context: LaunchContext) -> None:
        name = perform_substitutions(context, self.name)
        context.environment[name] = perform_substitutions(context, self.value)


@expose_action('unset_env')
class UnsetEnvironmentVariable(_Named):

    def execute(self, context: LaunchContext) -> None:
        context.environment.pop(perform_substitutions(context, self.name), None)


@expose_action('append_env')
class AppendEnvironmentVariable(_NamedValue):

    _texts = {**_NamedValue._texts, 'separator': 'separator?'}
    _typed = {'prepend': bool}

    def __init__(
        self, name: _base.SomeSubstitutionsType, value: _base.SomeSubstitutionsType,
        prepend: bool | _base.SomeSubstitutionsType = False,
        separator: _base.SomeSubstitutionsType = os.pathsep, **kwargs: Any
    ) -> None:
        super().__init__(name, value, **kwargs)
        self.prepend = normalize_typed_substitution(prepend, bool)
        self.separator = normalize(separator)

    def execute(self, context: LaunchContext) -> None:
        name = perform_substitutions(context, self.name)
        parts = [perform_substitutions(context, self.value)]
        prepend = perform_typed_substitution(context, self.prepend, bool)
        if name in context.environment:
            parts.insert(len(parts) if prepend else 0, context.environment[name])
        context.environment[name] = perform_substitutions(context, self.separator).join(parts)


class PushEnvironment(_base.Action):

    def execute(self, context: LaunchContext) -> None:
        context._push_environment()


class PopEnvironment(_base.Action):

    def execute(self, context: LaunchContext) -> None:
        context._pop_environment()


@expose_action('reset_env')
class ResetEnvironment(_base.Action):

    def execute(self, context: LaunchContext) -> None:
        context._reset_environment()


@expose_action('let')
class SetLaunchConfiguration(_NamedValue):

    def execute(self, context: LaunchContext) -> None:
        name = perform_substitutions(context, self.name)
        context.launch_configurations[name] = perform_substitutions(context, self.value)


class UnsetLaunchConfiguration(_Named):

    def execute(self, context: LaunchContext) -> None:
        context.launch_configurations.pop(perform_substitutions(context, self.name), None)


class PushLaunchConfigurations(_base.Action):

    def execute(self, context: LaunchContext) -> None:
        context._push_launch_configurations()


class PopLaunchConfigurations(_base.Action):

    def execute(self, context: LaunchContext) -> None:
        context._pop_launch_configurations()


@expose_action('reset')
class ResetLaunchConfigurations(_base.Action):
    """Removes all launch configurations and sets the given ones, evaluated before that."""

    _role = 'reset'

    def __init__(
        self, launch_configurations: dict[Any, Any] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.__launch_configurations = launch_configurations or {}

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> _base.ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['launch_configurations'] = parse_pairs(entity, parser, 'keep')
        return cls, kwargs

    def execute(self, context: LaunchContext) -> None:
        def text(given: _base.SomeSubstitutionsType) -> str:
            return perform_substitutions(context, normalize(given))

        kept = {text(name): text(value) for name, value in self.__launch_configurations.items()}
        context.launch_configurations.clear()
        context.launch_configurations.update(kept)


@expose_action('arg')
class DeclareLaunchArgument(_base.Action):
    """
    Declares a launch configuration that can be given to the launch file.

    :param default_value: without one the argument is required.
    :param choices: the values that are allowed, if not all are.
    :raises RuntimeError: for no choices, or a default that isn't one of them.
    """

    _role = 'argument'
    _texts = {'default_value': 'default?'}

    def __init__(
        self, name: str, *, default_value: _base.SomeSubstitutionsType | None = None,
        description: str | None = None, choices: list[str] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.name = name
        self.default_value = None if default_value is None else normalize(default_value)
        if choices is not None:
            if not choices:
                raise RuntimeError(
                    'Provided choices arg is empty. Use None to ignore the choice list.')
            if isinstance(default_value, str) and default_value not in choices:
                raise RuntimeError(f'Provided default_value "{default_value}" is not in provided '
                                   f'choices "{choices}".')
        if description is None:
            description = 'no description given' if choices is None else f'One of: {choices}'
        elif choices is not None:
            dot = '' if description.endswith('.') else '.'
            description += f'{dot} Valid choices are: {choices}'
        self.description = description
        self.choices = choices
        self._conditionally_included = False

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> _base.ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['name'] = parser.escape_characters(entity.get_attr('name'))
        description = entity.get_attr('description', optional=True)
        if description is not None:
            kwargs['description'] = parser.escape_characters(description)
        choices = entity.get_attr('choice', data_type=List[Entity], optional=True)
        if choices is not None:
            kwargs['choices'] = [
                parser.escape_characters(choice.get_attr('value')) for choice in choices]
        return cls, kwargs

    def execute(self, context: LaunchContext) -> None:
        configurations = context.launch_configurations
        if self.name not in configurations:
            if self.default_value is None:
                raise RuntimeError(f'Required launch argument "{self.name}" (description: '
                                   f'"{self.description}") was not provided')
            configurations[self.name] = perform_substitutions(context, self.default_value)
        value = configurations[self.name]
        if self.choices is not None and value not in self.choices:
            raise RuntimeError(f'Argument "{self.name}" provided value "{value}" is not valid. '
                               f'Valid options are: {self.choices}')


class EmitEvent(_base.Action):

    def __init__(self, *, event: _base.Event, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not is_a_subclass(event, _base.Event):
            raise RuntimeError(f"EmitEvent() expected an event instance, got '{event}'.")
        self.event = event

    def execute(self, context: LaunchContext) -> _base.Entities | None:
        context.emit_event_sync(self.event)
        return None


@expose_action('shutdown')
class Shutdown(EmitEvent):

    _texts = {'reason': 'reason?'}

    def __init__(self, *, reason: Any = 'reason not given', **kwargs: Any) -> None:
        super().__init__(event=ShutdownEvent(reason=reason), **kwargs)

    def execute(self, context: LaunchContext) -> _base.Entities | None:
        event = context.get_locals_as_dict().get('event')
        if isinstance(event, ProcessExited):
            _logger.info(
                f'process[{event.process_name}] was required: shutting down launched system')
        return super().execute(context)


@expose_action('log')
class LogInfo(_base.Action):

    _texts = {'msg': 'message'}

    def __init__(self, *, msg: _base.SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.msg = normalize(msg)
        self.__logger = launch.logging.get_logger('launch.user')

    def execute(self, context: LaunchContext) -> None:
        self.__logger.info(perform_substitutions(context, self.msg))


class RegisterEventHandler(_base.Action):

    def __init__(self, event_handler: _base.BaseEventHandler, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.event_handler = event_handler

    def execute(self, context: LaunchContext) -> None:
        context.register_event_handler(self.event_handler)

    def describe_conditional_sub_entities(self) -> _base.Conditional:
        text, entities = self.event_handler.describe()
        return [(text, normalize_to_list_of_entities(entities))] if entities else []


class OpaqueFunction(_base.Action):
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

    def execute(self, context: LaunchContext) -> _base.Entities | None:
        entities: _base.Entities | None = self.__function(context, *self.__args, **self.__kwargs)
        return entities
