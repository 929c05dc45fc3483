# SPDX-License-Identifier: Apache-2.0
"""Actions on environment variables and launch configurations."""
from __future__ import annotations

import os
from typing import Any, Dict, List, Optional, TYPE_CHECKING, Union

import launch.logging

from ..action import Action, ParsedAction
from ..frontend.entity import Entity
from ..frontend.expose import expose_action
from ..launch_context import LaunchContext
from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from ..utilities import normalize_to_list_of_substitutions, perform_substitutions
from ..utilities.type_utils import normalize_typed_substitution, perform_typed_substitution

if TYPE_CHECKING:
    from ..frontend import Parser

SomeConfigurations = Dict[SomeSubstitutionsType, SomeSubstitutionsType]


def parse_keeps(entity: Entity, parser: Parser) -> Dict[str, Any]:
    """Return the argument ``launch_configurations`` from ``<keep name= value=/>`` elements."""
    keeps = entity.get_attr('keep', data_type=List[Entity], optional=True)
    if keeps is None:
        return {}
    configurations = {
        tuple(parser.parse_substitution(keep.get_attr('name'))):
        parser.parse_substitution(keep.get_attr('value')) for keep in keeps}
    for keep in keeps:
        keep.assert_entity_completely_parsed()
    return {'launch_configurations': configurations}


class _Named(Action):
    """Base of actions on something that has a name."""

    def __init__(self, name: SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__name = normalize_to_list_of_substitutions(name)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['name'] = parser.parse_substitution(entity.get_attr('name'))
        return cls, kwargs

    @property
    def name(self) -> List[Substitution]:
        """The name."""
        return self.__name


class _NamedValue(_Named):
    """Base of actions that give something that has a name a value."""

    def __init__(
        self, name: SomeSubstitutionsType, value: SomeSubstitutionsType, **kwargs: Any
    ) -> None:
        super().__init__(name, **kwargs)
        self.__value = normalize_to_list_of_substitutions(value)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['value'] = parser.parse_substitution(entity.get_attr('value'))
        return cls, kwargs

    @property
    def value(self) -> List[Substitution]:
        """The value."""
        return self.__value


@expose_action('set_env')
class SetEnvironmentVariable(_NamedValue):
    """Sets an environment variable, for this process and those started from now on."""

    def execute(self, context: LaunchContext) -> None:
        name = perform_substitutions(context, self.name)
        context.environment[name] = perform_substitutions(context, self.value)


@expose_action('unset_env')
class UnsetEnvironmentVariable(_Named):
    """Removes an environment variable, if it is there."""

    def execute(self, context: LaunchContext) -> None:
        context.environment.pop(perform_substitutions(context, self.name), None)


@expose_action('append_env')
class AppendEnvironmentVariable(_NamedValue):
    """
    Adds to an environment variable, behind what is there or before it.

    :param separator: what to put between, by default what separates paths.
    """

    def __init__(
        self, name: SomeSubstitutionsType, value: SomeSubstitutionsType,
        prepend: Union[bool, SomeSubstitutionsType] = False,
        separator: SomeSubstitutionsType = os.pathsep, **kwargs: Any
    ) -> None:
        super().__init__(name, value, **kwargs)
        self.__prepend = normalize_typed_substitution(prepend, bool)
        self.__separator = normalize_to_list_of_substitutions(separator)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        prepend = entity.get_attr('prepend', optional=True, data_type=bool, can_be_str=True)
        if prepend is not None:
            kwargs['prepend'] = parser.parse_if_substitutions(prepend)
        separator = entity.get_attr('separator', optional=True)
        if separator is not None:
            kwargs['separator'] = parser.parse_substitution(separator)
        return cls, kwargs

    @property
    def prepend(self) -> Any:
        """Whether the value goes before what is there."""
        return self.__prepend

    @property
    def separator(self) -> List[Substitution]:
        """What goes between."""
        return self.__separator

    def execute(self, context: LaunchContext) -> None:
        name = perform_substitutions(context, self.name)
        parts = [perform_substitutions(context, self.value)]
        prepend = perform_typed_substitution(context, self.prepend, bool)
        if name in context.environment:
            parts.insert(len(parts) if prepend else 0, context.environment[name])
        context.environment[name] = perform_substitutions(context, self.separator).join(parts)


class PushEnvironment(Action):
    """Saves the environment."""

    def execute(self, context: LaunchContext) -> None:
        context._push_environment()


class PopEnvironment(Action):
    """Restores the environment that was saved last."""

    def execute(self, context: LaunchContext) -> None:
        context._pop_environment()


@expose_action('reset_env')
class ResetEnvironment(Action):
    """Restores the environment that the launch began with."""

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        return cls, super().parse(entity, parser)[1]

    def execute(self, context: LaunchContext) -> None:
        context._reset_environment()


@expose_action('let')
class SetLaunchConfiguration(_NamedValue):
    """Sets a launch configuration."""

    def execute(self, context: LaunchContext) -> None:
        name = perform_substitutions(context, self.name)
        context.launch_configurations[name] = perform_substitutions(context, self.value)


class UnsetLaunchConfiguration(_Named):
    """Removes a launch configuration, if it is there."""

    def execute(self, context: LaunchContext) -> None:
        context.launch_configurations.pop(perform_substitutions(context, self.name), None)


class PushLaunchConfigurations(Action):
    """Saves the launch configurations."""

    def execute(self, context: LaunchContext) -> None:
        context._push_launch_configurations()


class PopLaunchConfigurations(Action):
    """Restores the launch configurations that were saved last."""

    def execute(self, context: LaunchContext) -> None:
        context._pop_launch_configurations()


@expose_action('reset')
class ResetLaunchConfigurations(Action):
    """Removes all launch configurations and sets the given ones, evaluated before that."""

    def __init__(
        self, launch_configurations: Optional[SomeConfigurations] = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.__launch_configurations = launch_configurations or {}

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs.update(parse_keeps(entity, parser))
        return cls, kwargs

    def execute(self, context: LaunchContext) -> None:
        def text(substitutions: SomeSubstitutionsType) -> str:
            return perform_substitutions(
                context, normalize_to_list_of_substitutions(substitutions))

        kept = {text(name): text(value) for name, value in self.__launch_configurations.items()}
        context.launch_configurations.clear()
        context.launch_configurations.update(kept)


@expose_action('arg')
class DeclareLaunchArgument(Action):
    """
    Declares a launch configuration that can be given to the launch file.

    :param default_value: without one the argument is required.
    :param choices: the values that are allowed, if not all are.
    :raises RuntimeError: for no choices, or a default that isn't one of them.
    """

    def __init__(
        self, name: str, *, default_value: Optional[SomeSubstitutionsType] = None,
        description: Optional[str] = None, choices: Optional[List[str]] = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.__name = name
        self.__logger = launch.logging.get_logger(__name__)
        self.__default_value = None if default_value is None else (
            normalize_to_list_of_substitutions(default_value))
        if choices is not None:
            if not choices:
                self.__refuse('Provided choices arg is empty. Use None to ignore the choice list.')
            if isinstance(default_value, str) and default_value not in choices:
                self.__refuse(f'Provided default_value "{default_value}" is not in provided '
                              f'choices "{choices}".')
        if description is None:
            description = 'no description given' if choices is None else f'One of: {choices}'
        elif choices is not None:
            dot = '' if description.endswith('.') else '.'
            description += f'{dot} Valid choices are: {choices}'
        self.__description = description
        self.__choices = choices
        self._conditionally_included = False

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['name'] = parser.escape_characters(entity.get_attr('name'))
        default = entity.get_attr('default', optional=True)
        if default is not None:
            kwargs['default_value'] = parser.parse_substitution(default)
        description = entity.get_attr('description', optional=True)
        if description is not None:
            kwargs['description'] = parser.escape_characters(description)
        choices = entity.get_attr('choice', data_type=List[Entity], optional=True)
        if choices is not None:
            kwargs['choices'] = [
                parser.escape_characters(choice.get_attr('value')) for choice in choices]
        return cls, kwargs

    @property
    def name(self) -> str:
        """The argument's name."""
        return self.__name

    @property
    def default_value(self) -> Optional[List[Substitution]]:
        """The default, if any."""
        return self.__default_value

    @property
    def description(self) -> str:
        """What it is for, in words."""
        return self.__description

    @property
    def choices(self) -> Optional[List[str]]:
        """The values that are allowed, if not all are."""
        return self.__choices

    def __refuse(self, text: str) -> None:
        self.__logger.error(text)
        raise RuntimeError(text)

    def execute(self, context: LaunchContext) -> None:
        configurations = context.launch_configurations
        if self.name not in configurations:
            if self.default_value is None:
                self.__logger.error(
                    f'Required launch argument "{self.name}" (description: '
                    f'"{self.description}") was not provided')
                raise RuntimeError(f'Required launch argument "{self.name}" was not provided.')
            configurations[self.name] = perform_substitutions(context, self.default_value)
        value = configurations[self.name]
        if self.choices is not None and value not in self.choices:
            self.__refuse(f'Argument "{self.name}" provided value "{value}" is not valid. '
                          f'Valid options are: {self.choices}')
