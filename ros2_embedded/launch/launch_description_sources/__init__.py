# SPDX-License-Identifier: Apache-2.0
"""Launch descriptions from launch files."""
from __future__ import annotations

from importlib.machinery import SourceFileLoader
import os
from types import ModuleType
from typing import Callable

from .._base import InvalidLaunchFileError as InvalidLaunchFileError
from .._base import SomeSubstitutionsType
from ..frontend import InvalidFrontendLaunchFileError as InvalidFrontendLaunchFileError
from ..frontend import Parser
from ..launch_description import LaunchDescription, LaunchDescriptionSource


class InvalidPythonLaunchFileError(Exception):
    pass


def load_python_launch_file_as_module(python_launch_file_path: str) -> ModuleType:
    """Execute a Python file, whatever its name ends with, as a module of its own."""
    loader = SourceFileLoader('python_launch_file', python_launch_file_path)
    module = ModuleType(loader.name)
    module.__file__ = python_launch_file_path
    module.__loader__ = loader
    loader.exec_module(module)
    return module


def get_launch_description_from_python_launch_file(
    python_launch_file_path: str
) -> LaunchDescription:
    module = load_python_launch_file_as_module(python_launch_file_path)
    if not hasattr(module, 'generate_launch_description'):
        raise InvalidPythonLaunchFileError(
            f"launch file at '{python_launch_file_path}' does not contain the required function "
            "'generate_launch_description()'")
    description = module.generate_launch_description()
    if not isinstance(description, LaunchDescription):
        raise InvalidPythonLaunchFileError(
            f"generate_launch_description() of '{python_launch_file_path}' returned "
            f'{type(description).__name__}, no LaunchDescription')
    return description


def get_launch_description_from_frontend_launch_file(
    frontend_launch_file_path: str
) -> LaunchDescription:
    entity, parser = Parser.load(frontend_launch_file_path)
    return parser.parse_description(entity)


def get_launch_description_from_any_launch_file(launch_file_path: str) -> LaunchDescription:
    """
    Return what a launch file describes.

    :raises InvalidLaunchFileError: if nothing can read it.
    """
    name = os.path.basename(launch_file_path)
    loaders: list[Callable[[str], LaunchDescription]] = []
    if not name.endswith('.py'):
        loaders.append(get_launch_description_from_frontend_launch_file)
    if not Parser.is_filename_valid(name):
        loaders.append(get_launch_description_from_python_launch_file)
    errors: list[Exception] = []
    for load in loaders:
        try:
            return load(launch_file_path)
        except InvalidLaunchFileError as exc:
            if len(loaders) == 1:
                raise
            errors.append(exc)
        except Exception as exc:  # noqa: BLE001 - A launch file can raise anything.
            errors.append(exc)
    raise InvalidLaunchFileError(likely_errors=errors, path=launch_file_path)


class _FileSource(LaunchDescriptionSource):

    _load: Callable[[str], LaunchDescription]

    def __init__(self, launch_file_path: SomeSubstitutionsType) -> None:
        super().__init__(None, launch_file_path)

    def _get_launch_description(self, location: str) -> LaunchDescription:
        return self._load(location)


class AnyLaunchDescriptionSource(_FileSource):

    _load = staticmethod(get_launch_description_from_any_launch_file)


class PythonLaunchDescriptionSource(_FileSource):

    _load = staticmethod(get_launch_description_from_python_launch_file)


class FrontendLaunchDescriptionSource(_FileSource):
    """A launch file that a frontend reads, whichever it is."""

    _load = staticmethod(get_launch_description_from_frontend_launch_file)
