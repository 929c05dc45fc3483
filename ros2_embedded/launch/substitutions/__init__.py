# SPDX-License-Identifier: Apache-2.0
"""Texts that are only known when the launch runs."""
from __future__ import annotations

import collections.abc
import importlib
import math
import os
from typing import Any, Iterable, Sequence

from embedded_default.lacking import lacking
import launch.logging

from .._base import SomeSubstitutionsType, Substitution, TextSubstitution, TRUTHS
from ..frontend.expose import expose_substitution
from ..launch_context import LaunchContext
from ..utilities import normalize_to_list_of_substitutions, perform_substitutions
from ..utilities.type_utils import is_substitution, perform_typed_substitution

__all__ = [
    'AndSubstitution', 'Command', 'EqualsSubstitution', 'EnvironmentVariable', 'FileContent',
    'FindExecutable', 'LaunchConfiguration', 'LocalSubstitution', 'NotSubstitution',
    'NotEqualsSubstitution', 'OrSubstitution', 'PathJoinSubstitution', 'PathSubstitution',
    'PythonExpression', 'SubstitutionFailure', 'TextSubstitution', 'ThisLaunchFile',
    'ThisLaunchFileDir']
__getattr__ = lacking(__name__, 'AllSubstitution AnonName AnySubstitution BooleanSubstitution '
                                'IfElseSubstitution LaunchLogDir')

Parsed = tuple[type[Any], dict[str, Any]]
Substitutions = list[Substitution]


class SubstitutionFailure(RuntimeError):
    """A substitution has no value in this context."""


def described(substitutions: Iterable[Substitution]) -> str:
    return ' + '.join(sub.describe() for sub in substitutions)


def normalized_default(default: Any) -> Substitutions | None:
    """Return a default of any type as substitutions; None stays None."""
    if default is None:
        return None
    if isinstance(default, str) or not isinstance(default, collections.abc.Iterable):
        default = (default,)
    return normalize_to_list_of_substitutions([
        item if isinstance(item, (str, Substitution)) else str(item) for item in default])


class ParsedSubstitution(Substitution):
    """Base of those that launch files write as ``$(name argument ...)``."""

    #: The parameters that the arguments are for; a question mark where they may be absent.
    _parameters: tuple[str, ...] = ()
    #: What it is called in descriptions, if not by its class's name.
    _label = ''

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """
        Return the class and the keyword arguments.

        :raises TypeError: for too few or too many.
        """
        least = sum(not name.endswith('?') for name in cls._parameters)
        if not least <= len(data) <= len(cls._parameters):
            raise TypeError(
                f'{cls.__name__} substitution expects {least} to {len(cls._parameters)} '
                f'arguments, got {len(data)}')
        return cls, {name.rstrip('?'): value for name, value in zip(cls._parameters, data)}

    def describe(self) -> str:
        shown = [described(getattr(self, name)) for name in self._parameters if name[-1] != '?']
        return f"{self._label or type(self).__name__}({', '.join(shown)})"


@expose_substitution('var')
class LaunchConfiguration(ParsedSubstitution):
    """The value of a launch configuration, or the default."""

    _parameters = ('variable_name', 'default?')
    _label = 'LaunchConfig'

    def __init__(self, variable_name: SomeSubstitutionsType, *, default: Any = None) -> None:
        self.variable_name = normalize_to_list_of_substitutions(variable_name)
        self.__default = normalized_default(default)

    def perform(self, context: LaunchContext) -> str:
        name = perform_substitutions(context, self.variable_name)
        if name in context.launch_configurations:
            value: str = context.launch_configurations[name]
            return value
        if self.__default is None:
            raise SubstitutionFailure(f"launch configuration '{name}' does not exist")
        return perform_substitutions(context, self.__default)


@expose_substitution('env')
class EnvironmentVariable(ParsedSubstitution):
    """The value of an environment variable, or the default."""

    _parameters = ('name', 'default_value?')
    _label = 'EnvVar'

    def __init__(
        self, name: SomeSubstitutionsType, *,
        default_value: SomeSubstitutionsType | None = None
    ) -> None:
        self.name = normalize_to_list_of_substitutions(name)
        self.default_value = normalized_default(default_value)

    def perform(self, context: LaunchContext) -> str:
        name = perform_substitutions(context, self.name)
        if name in context.environment:
            return context.environment[name]
        if self.default_value is None:
            raise SubstitutionFailure(f"environment variable '{name}' does not exist")
        return perform_substitutions(context, self.default_value)


class LocalSubstitution(Substitution):
    """The value of an expression over the context's local variables."""

    def __init__(self, expression: str, description: str | None = None) -> None:
        self.expression = expression
        self.description = description

    def describe(self) -> str:
        return f"LocalVar('{self.description or self.expression}')"

    def perform(self, context: LaunchContext) -> str:
        value: str = eval('context.locals.' + self.expression)  # noqa: S307
        return value


class PathJoinSubstitution(Substitution):
    """Parts of a path, joined; ``/`` adds one more. A part is a substitution or a list of them."""

    def __init__(self, substitutions: Iterable[SomeSubstitutionsType]) -> None:
        self.substitutions = [normalize_to_list_of_substitutions(part) for part in substitutions]

    def __truediv__(self, part: SomeSubstitutionsType) -> PathJoinSubstitution:
        return PathJoinSubstitution([self, part])

    def describe(self) -> str:
        return f"PathJoin('{' + '.join(map(described, self.substitutions))}')"

    def perform(self, context: LaunchContext) -> str:
        return os.path.join(*(perform_substitutions(context, part) for part in self.substitutions))


class PathSubstitution(PathJoinSubstitution):
    """A path to which ``/`` adds parts; base of substitutions that find a directory."""

    def __init__(self, path: SomeSubstitutionsType) -> None:
        super().__init__(normalize_to_list_of_substitutions(path))


@expose_substitution('filename')
class ThisLaunchFile(ParsedSubstitution):

    _local = 'current_launch_file_path'

    def perform(self, context: LaunchContext) -> str:
        value: str | None = context.get_locals_as_dict().get(self._local)
        if value is None:
            raise SubstitutionFailure(
                f'{type(self).__name__} used outside of a launch file (in a script)')
        return value


@expose_substitution('dirname')
class ThisLaunchFileDir(ThisLaunchFile, PathSubstitution):

    _local = 'current_launch_file_directory'

    def __init__(self) -> None:
        super().__init__(())


@expose_substitution('command')
class Command(ParsedSubstitution):
    """
    The standard output of a command.

    :param on_stderr: what standard error's output means: 'fail', 'ignore', 'warn', or
        'capture' to have it in the text.
    """

    _parameters = ('command', 'on_stderr?')
    _runs_code = True

    def __init__(
        self, command: SomeSubstitutionsType, *, on_stderr: SomeSubstitutionsType = 'fail'
    ) -> None:
        self.command = normalize_to_list_of_substitutions(command)
        self.on_stderr = normalize_to_list_of_substitutions(on_stderr)

    def perform(self, context: LaunchContext) -> str:
        import shlex
        import subprocess
        command = perform_substitutions(context, self.command)
        on_stderr = perform_substitutions(context, self.on_stderr)
        if on_stderr not in ('fail', 'ignore', 'warn', 'capture'):
            raise SubstitutionFailure(
                "expected 'on_stderr' to be one of: 'fail', 'ignore', 'warn' or 'capture'")
        try:
            result = subprocess.run(
                shlex.split(command), stdout=subprocess.PIPE, text=True,
                stderr=subprocess.STDOUT if on_stderr == 'capture' else subprocess.PIPE)
        except FileNotFoundError as exc:
            raise SubstitutionFailure(f'file not found: {exc}') from exc
        stderr = f'\nCaptured stderr output:\n{result.stderr}' if result.stderr else ''
        if result.returncode != 0:
            raise SubstitutionFailure(f'executed command failed. Command: {command}{stderr}')
        if stderr and on_stderr in ('fail', 'warn'):
            text = f'executed command showed stderr output. Command: {command}{stderr}'
            if on_stderr == 'fail':
                raise SubstitutionFailure(text)
            launch.logging.get_logger().warning(text)
        return result.stdout


@expose_substitution('file-content')
class FileContent(ParsedSubstitution):

    _parameters = ('path',)

    def __init__(self, path: SomeSubstitutionsType) -> None:
        self.path = normalize_to_list_of_substitutions(path)

    def perform(self, context: LaunchContext) -> str:
        path = perform_substitutions(context, self.path)
        try:
            with open(path) as file:
                return file.read()
        except FileNotFoundError as exc:
            raise SubstitutionFailure(f'File not found: {path}') from exc


@expose_substitution('find-exec')
class FindExecutable(ParsedSubstitution):

    _parameters = ('name',)
    _label = 'FindExec'

    def __init__(self, *, name: SomeSubstitutionsType) -> None:
        self.name = normalize_to_list_of_substitutions(name)

    def perform(self, context: LaunchContext) -> str:
        import shutil
        path = shutil.which(perform_substitutions(context, self.name))
        if path is None:
            raise SubstitutionFailure(f"executable '{self.name}' not found on the PATH")
        return path


@expose_substitution('eval')
class PythonExpression(ParsedSubstitution):
    """The value of a Python expression over modules; over ``math``, its content too."""

    _runs_code = True
    _parameters = ('expression', 'python_modules?')

    def __init__(
        self, expression: SomeSubstitutionsType, python_modules: SomeSubstitutionsType = ('math',)
    ) -> None:
        self.expression = normalize_to_list_of_substitutions(expression)
        self.python_modules = normalize_to_list_of_substitutions(python_modules)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        _, kwargs = super().parse(data)
        if 'python_modules' in kwargs:
            names = ''.join(getattr(sub, 'text', '') for sub in kwargs['python_modules'])
            kwargs['python_modules'] = [name.strip() for name in names.split(',') if name]
        return cls, kwargs

    def describe(self) -> str:
        modules = ', '.join(sub.describe() for sub in self.python_modules)
        return f'PythonExpr({described(self.expression)}, [{modules}])'

    def perform(self, context: LaunchContext) -> str:
        names: dict[str, Any] = {}
        for sub in self.python_modules:
            module = importlib.import_module(context.perform_substitution(sub))
            if module is math:
                names.update(vars(math))
            names[module.__name__] = module
        return str(eval(perform_substitutions(context, self.expression), {}, names))  # noqa: S307


def _truth(context: LaunchContext, value: Substitutions) -> bool:
    try:
        return bool(perform_typed_substitution(context, value, bool))
    except (TypeError, ValueError) as exc:
        raise SubstitutionFailure(exc) from exc


def _text(truth: bool) -> str:
    return 'true' if truth else 'false'


@expose_substitution('not')
class NotSubstitution(ParsedSubstitution):

    _parameters = ('value',)

    def __init__(self, value: SomeSubstitutionsType) -> None:
        self.value = normalize_to_list_of_substitutions(value)

    def perform(self, context: LaunchContext) -> str:
        return _text(not _truth(context, self.value))


@expose_substitution('and')
class AndSubstitution(ParsedSubstitution):
    """Whether both sides are true; both are evaluated."""

    _parameters = ('left', 'right')
    _combine = staticmethod(all)

    def __init__(self, left: Any, right: Any) -> None:
        self.left = normalize_to_list_of_substitutions(left)
        self.right = normalize_to_list_of_substitutions(right)

    def perform(self, context: LaunchContext) -> str:
        return _text(self._combine([_truth(context, self.left), _truth(context, self.right)]))


@expose_substitution('or')
class OrSubstitution(AndSubstitution):
    """Whether a side is true; both are evaluated."""

    _combine = staticmethod(any)


def _comparable(side: Any) -> Any:
    if is_substitution(side):
        return side
    return '' if side is None else _text(side) if isinstance(side, bool) else str(side)


@expose_substitution('equals')
class EqualsSubstitution(AndSubstitution):
    """Whether both sides are equal: as booleans, as numbers, or else as texts."""

    def __init__(self, left: Any, right: Any) -> None:
        super().__init__(_comparable(left), _comparable(right))

    def perform(self, context: LaunchContext) -> str:
        left = perform_substitutions(context, self.left)
        right = perform_substitutions(context, self.right)
        if left.lower() in TRUTHS and right.lower() in TRUTHS:
            return _text(TRUTHS[left.lower()] == TRUTHS[right.lower()])
        try:
            return _text(math.isclose(float(left), float(right)))
        except ValueError:
            return _text(left == right)


@expose_substitution('not-equals')
class NotEqualsSubstitution(EqualsSubstitution):

    def perform(self, context: LaunchContext) -> str:
        return _text(super().perform(context) != 'true')
