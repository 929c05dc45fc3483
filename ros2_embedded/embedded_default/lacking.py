# SPDX-License-Identifier: Apache-2.0
"""Errors for what ROS 2 has and the embedded default hasn't."""

from collections.abc import Callable
import sys
from typing import Any

_MODULES = {
    'composition_interfaces', 'launch.utilities.typing_file_path', 'launch_pytest',
    'launch_ros.parameters_type', 'launch_ros.remap_rule_type', 'launch_testing',
    'rosidl_runtime_py.get_interfaces', 'rosidl_runtime_py.import_message'}

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


def lacking(where: str, names: str) -> Callable[[str], Any]:
    """Give a module's ``__getattr__`` for names that only ROS 2 has there."""
    LACKING[where] = names.split()

    def look_up(name: str) -> Any:
        if name in LACKING[where]:
            # no AttributeError: an import statement wouldn't show its text
            raise ImportError(str(NotEmbeddedError(f'{where}.{name}')))
        raise AttributeError(f"'{where}' has no attribute '{name}'")
    return look_up


class _Finder:
    """Refuse modules of ROS 2 that neither we nor the user's workspaces provide."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> None:
        if name in _MODULES:
            raise ModuleNotFoundError(str(NotEmbeddedError(name)), name=name)


sys.meta_path.append(_Finder)
