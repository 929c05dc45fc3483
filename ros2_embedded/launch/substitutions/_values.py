# SPDX-License-Identifier: Apache-2.0
"""Texts, and what the launch itself knows."""
from __future__ import annotations

import collections.abc
import os
from typing import Any, Dict, Iterable, List, Optional, Sequence, Tuple, Type, Union

from ..frontend.expose import expose_substitution
from ..launch_context import LaunchContext
from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from ..utilities import (
    ensure_argument_type,
    normalize_to_list_of_substitutions,
    perform_substitutions,
)

Parsed = Tuple[Type[Any], Dict[str, Any]]


class SubstitutionFailure(RuntimeError):
    """A substitution has no value in this context."""

    def __init__(self, msg: Any) -> None:
        super().__init__(msg)


def described(substitutions: Iterable[Substitution]) -> str:
    """Return substitutions in words."""
    return ' + '.join(sub.describe() for sub in substitutions)


def arguments(
    data: Sequence[SomeSubstitutionsType], name: str, *names: str, optional: int = 0,
    error: Type[Exception] = TypeError
) -> Dict[str, Any]:
    """
    Return a frontend's positional arguments by name; the last ``optional`` may be absent.

    :raises Exception: of the type ``error``, if there are too few or too many.
    """
    least = len(names) - optional
    if not least <= len(data) <= len(names):
        if not names:
            raise error(f"{name} substitution doesn't expect arguments")
        count = f'{least} or {len(names)}' if optional else f'{least}'
        plural = 's' if len(names) > 1 else ''
        raise error(f'{name} substitution expects {count} argument{plural}')
    return dict(zip(names, data))


def normalized_default(default: Any) -> Optional[List[Substitution]]:
    """Return a default of any type as substitutions; None stays None."""
    if default is None:
        return None
    items = default if isinstance(default, collections.abc.Iterable) else (default,)
    return normalize_to_list_of_substitutions([
        item if isinstance(item, (str, Substitution)) else str(item) for item in items])


class TextSubstitution(Substitution):
    """A text as it is."""

    def __init__(self, *, text: str) -> None:
        super().__init__()
        if not isinstance(text, str):
            raise TypeError(
                f"TextSubstitution expected Text object got '{type(text)}' instead.")
        self.__text = text

    @property
    def text(self) -> str:
        """The text."""
        return self.__text

    def describe(self) -> str:
        return f"'{self.text}'"

    def perform(self, context: LaunchContext) -> str:
        return self.text


@expose_substitution('var')
class LaunchConfiguration(Substitution):
    """The value of a launch configuration, or the default."""

    def __init__(self, variable_name: SomeSubstitutionsType, *, default: Any = None) -> None:
        super().__init__()
        self.__variable_name = normalize_to_list_of_substitutions(variable_name)
        self.__default = normalized_default(default)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(var name [default])``."""
        return cls, arguments(data, 'var', 'variable_name', 'default', optional=1)

    @property
    def variable_name(self) -> List[Substitution]:
        """The configuration's name."""
        return self.__variable_name

    def describe(self) -> str:
        return f'LaunchConfig({described(self.variable_name)})'

    def perform(self, context: LaunchContext) -> str:
        name = perform_substitutions(context, self.__variable_name)
        if name in context.launch_configurations:
            value: str = context.launch_configurations[name]
            return value
        if self.__default is None:
            raise SubstitutionFailure(f"launch configuration '{name}' does not exist")
        return perform_substitutions(context, self.__default)


@expose_substitution('env')
class EnvironmentVariable(Substitution):
    """The value of an environment variable, or the default."""

    def __init__(
        self, name: SomeSubstitutionsType, *,
        default_value: Optional[SomeSubstitutionsType] = None
    ) -> None:
        super().__init__()
        self.__name = normalize_to_list_of_substitutions(name)
        self.__default_value = None if default_value is None else (
            normalize_to_list_of_substitutions(default_value))

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(env name [default])``."""
        return cls, arguments(data, 'env', 'name', 'default_value', optional=1)

    @property
    def name(self) -> List[Substitution]:
        """The variable's name."""
        return self.__name

    @property
    def default_value(self) -> Optional[List[Substitution]]:
        """The default, if any."""
        return self.__default_value

    def describe(self) -> str:
        return f'EnvVar({described(self.name)})'

    def perform(self, context: LaunchContext) -> str:
        name = perform_substitutions(context, self.name)
        if name in context.environment:
            return context.environment[name]
        if self.default_value is None:
            raise SubstitutionFailure(f"environment variable '{name}' does not exist")
        return perform_substitutions(context, self.default_value)


class LocalSubstitution(Substitution):
    """The value of an expression over the context's local variables."""

    def __init__(self, expression: str, description: Optional[str] = None) -> None:
        super().__init__()
        ensure_argument_type(expression, str, 'expression', 'LocalSubstitution')
        self.__expression = expression
        self.__description = description

    @property
    def expression(self) -> str:
        """The expression."""
        return self.__expression

    @property
    def description(self) -> Optional[str]:
        """What it is, in words."""
        return self.__description

    def describe(self) -> str:
        return f"LocalVar('{self.description or self.expression}')"

    def perform(self, context: LaunchContext) -> str:
        value: str = eval('context.locals.' + self.expression)  # noqa: S307
        return value


class PathJoinSubstitution(Substitution):
    """Path components, joined."""

    def __init__(self, substitutions: Iterable[Union[str, Substitution]]) -> None:
        self.__substitutions = normalize_to_list_of_substitutions(substitutions)

    @property
    def substitutions(self) -> Iterable[Substitution]:
        """The components."""
        return self.__substitutions

    def describe(self) -> str:
        return f"PathJoin('{described(self.substitutions)}')"

    def perform(self, context: LaunchContext) -> str:
        return os.path.join(*(sub.perform(context) for sub in self.__substitutions))


@expose_substitution('anon')
class AnonName(Substitution):
    """The name with something unique behind it, the same throughout a launch."""

    def __init__(self, name: SomeSubstitutionsType) -> None:
        super().__init__()
        self.__name = normalize_to_list_of_substitutions(name)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(anon name)``."""
        return cls, arguments(data, 'anon', 'name')

    @property
    def name(self) -> List[Substitution]:
        """The name."""
        return self.__name

    def describe(self) -> str:
        return f'AnonName({described(self.name)})'

    def perform(self, context: LaunchContext) -> str:
        name = perform_substitutions(context, self.name)
        key = 'anon' + name
        if key not in context.launch_configurations:
            context.launch_configurations[key] = self.compute_name(name)
        value: str = context.launch_configurations[key]
        return value

    def compute_name(self, id_value: str) -> str:
        """Return a new unique name, fit for a node."""
        import random
        unique = (
            f'{id_value}_{os.uname().nodename}_{os.getpid()}_{random.getrandbits(63)}')
        return unique.translate(str.maketrans('.-:', '___'))


class _Argumentless(Substitution):
    """Base of those that take no arguments."""

    _name: str

    def __init__(self) -> None:
        super().__init__()

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(name)``."""
        return cls, arguments(data, cls._name)

    def describe(self) -> str:
        return f'{type(self).__name__}()'


@expose_substitution('launch_log_dir')
@expose_substitution('log_dir')
class LaunchLogDir(_Argumentless):
    """The directory of this launch's log files."""

    _name = 'launch_log_dir/log_dir'

    def perform(self, context: LaunchContext) -> str:
        from ..logging import launch_config
        return launch_config.log_dir


class _OfThisLaunchFile(_Argumentless):
    _local: str

    def perform(self, context: LaunchContext) -> str:
        variables = context.get_locals_as_dict()
        if self._local not in variables:
            raise SubstitutionFailure(
                f'{type(self).__name__} used outside of a launch file (in a script)')
        value: str = variables[self._local]
        return value


@expose_substitution('filename')
class ThisLaunchFile(_OfThisLaunchFile):
    """The path of the launch file that this stands in."""

    _name, _local = 'filename', 'current_launch_file_path'


@expose_substitution('dirname')
class ThisLaunchFileDir(_OfThisLaunchFile):
    """The directory of the launch file that this stands in."""

    _name, _local = 'dirname', 'current_launch_file_directory'
