# SPDX-License-Identifier: Apache-2.0
"""Errors for what ROS 2 has and the embedded default hasn't."""

from collections.abc import Callable
import sys
from typing import Any

_MODULES = {
    'launch.utilities.typing_file_path', 'launch_testing', 'launch_ros.parameters_type',
    'launch_ros.remap_rule_type', 'rosidl_runtime_py.get_interfaces',
    'rosidl_runtime_py.import_message', 'launch_pytest'}

#: The names that modules refuse, by module.
LACKING: dict[str, list[str]] = {}


class NotEmbeddedError(RuntimeError):
    """
    A part of ROS 2 that the embedded default doesn't have.

    :param part: its name, as in ROS 2's documentation.
    """

    def __init__(self, part: str) -> None:
        super().__init__(
            f'{part} is not part of the embedded default; ROS 2 Jazzy has it: '
            'https://docs.ros.org/en/jazzy/Installation.html')


def lacking(where: str, names: str,
            error: type[Exception] = ImportError) -> Callable[[str], Any]:
    """Give a ``__getattr__``, by default a module's, for names that only ROS 2 has there."""
    LACKING[where] = names.split()

    def look_up(name: str) -> Any:
        if name in LACKING[where]:
            # by default no AttributeError: an import statement wouldn't show its text
            raise error(str(NotEmbeddedError(f'{where}.{name}')))
        raise AttributeError(f"'{where}' has no attribute '{name}'")
    return look_up


class _Finder:
    """Refuses modules that only ROS 2 has, also where an older version has left a folder."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> None:
        if name in _MODULES:
            raise ImportError(str(NotEmbeddedError(name)), name=name)


sys.meta_path.insert(0, _Finder)
