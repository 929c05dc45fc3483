# SPDX-License-Identifier: Apache-2.0
"""What commands, files and Python know."""
from __future__ import annotations

import collections.abc
from typing import Any, Dict, List, Sequence

from ..frontend.expose import expose_substitution
from ..launch_context import LaunchContext
from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from ..utilities import (
    ensure_argument_type,
    normalize_to_list_of_substitutions,
    perform_substitutions,
)
from ._values import arguments, described, Parsed, SubstitutionFailure


@expose_substitution('command')
class Command(Substitution):
    """
    The standard output of a command.

    :param on_stderr: what standard error's output means: 'fail', 'ignore', 'warn', or
        'capture' to have it in the text.
    """

    def __init__(
        self, command: SomeSubstitutionsType, *, on_stderr: SomeSubstitutionsType = 'fail'
    ) -> None:
        super().__init__()
        self.__command = normalize_to_list_of_substitutions(command)
        self.__on_stderr = normalize_to_list_of_substitutions(on_stderr)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(command 'command' [on_stderr])``."""
        return cls, arguments(
            data, 'command', 'command', 'on_stderr', optional=1, error=ValueError)

    @property
    def command(self) -> List[Substitution]:
        """The command line, split as a shell does, but run without one."""
        return self.__command

    @property
    def on_stderr(self) -> List[Substitution]:
        """What standard error's output means."""
        return self.__on_stderr

    def describe(self) -> str:
        return f'Command({described(self.command)})'

    def perform(self, context: LaunchContext) -> str:
        import shlex
        import subprocess

        import launch.logging
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
        if result.returncode != 0:
            text = f'executed command failed. Command: {command}'
            if result.stderr:
                text += f'\nCaptured stderr output: {result.stderr}'
            raise SubstitutionFailure(text)
        if result.stderr:
            text = (f'executed command showed stderr output. Command: {command}\n'
                    f'Captured stderr output:\n{result.stderr}')
            if on_stderr == 'fail':
                raise SubstitutionFailure(text)
            if on_stderr == 'warn':
                launch.logging.get_logger().warning(text)
        return result.stdout


@expose_substitution('file-content')
class FileContent(Substitution):
    """The content of a text file."""

    def __init__(self, path: SomeSubstitutionsType) -> None:
        super().__init__()
        self.__path = normalize_to_list_of_substitutions(path)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(file-content path)``."""
        return cls, arguments(data, 'file-content', 'path', error=AttributeError)

    @property
    def path(self) -> List[Substitution]:
        """The file's path."""
        return self.__path

    def describe(self) -> str:
        return f"FileContent({', '.join(sub.describe() for sub in self.path)})"

    def perform(self, context: LaunchContext) -> str:
        path = perform_substitutions(context, self.path)
        try:
            with open(path) as file:
                return file.read()
        except FileNotFoundError as exc:
            raise SubstitutionFailure(f'File not found: {path}') from exc


@expose_substitution('find-exec')
class FindExecutable(Substitution):
    """The path of an executable that PATH leads to."""

    def __init__(self, *, name: SomeSubstitutionsType) -> None:
        super().__init__()
        self.__name = normalize_to_list_of_substitutions(name)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(find-exec name)``."""
        return cls, arguments(data, 'find-exec', 'name', error=AttributeError)

    @property
    def name(self) -> List[Substitution]:
        """The executable's name."""
        return self.__name

    def describe(self) -> str:
        return f'FindExec({described(self.name)})'

    def perform(self, context: LaunchContext) -> str:
        import shutil
        path = shutil.which(perform_substitutions(context, self.name))
        if path is None:
            raise SubstitutionFailure(f"executable '{self.name}' not found on the PATH")
        return path


@expose_substitution('eval')
class PythonExpression(Substitution):
    """
    The value of a Python expression.

    :param python_modules: what the expression may use by name; of ``math``, its content too.
    """

    def __init__(
        self, expression: SomeSubstitutionsType,
        python_modules: SomeSubstitutionsType = ('math',)
    ) -> None:
        super().__init__()
        types = (str, Substitution, collections.abc.Iterable)
        ensure_argument_type(expression, types, 'expression', 'PythonExpression')
        ensure_argument_type(python_modules, types, 'python_modules', 'PythonExpression')
        self.__expression = normalize_to_list_of_substitutions(expression)
        self.__python_modules = normalize_to_list_of_substitutions(python_modules)

    @classmethod
    def parse(cls, data: Sequence[SomeSubstitutionsType]) -> Parsed:
        """Read ``$(eval 'expression' [modules, separated by commas])``."""
        kwargs = arguments(data, 'eval', 'expression', 'python_modules', optional=1)
        if 'python_modules' in kwargs:
            text = ''.join(getattr(sub, 'text', '') for sub in kwargs['python_modules'])
            kwargs['python_modules'] = [name.strip() for name in text.split(',')]
        return cls, kwargs

    @property
    def expression(self) -> List[Substitution]:
        """The expression."""
        return self.__expression

    @property
    def python_modules(self) -> List[Substitution]:
        """The modules' names."""
        return self.__python_modules

    def describe(self) -> str:
        modules = ', '.join(sub.describe() for sub in self.python_modules)
        return f'PythonExpr({described(self.expression)}, [{modules}])'

    def perform(self, context: LaunchContext) -> str:
        import importlib
        names: Dict[str, Any] = {}
        for sub in self.python_modules:
            module = importlib.import_module(context.perform_substitution(sub))
            if module.__name__ == 'math':
                names.update(vars(module))
            names[module.__name__] = module
        return str(eval(perform_substitutions(context, self.expression), {}, names))  # noqa: S307
