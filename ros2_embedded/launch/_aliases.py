# SPDX-License-Identifier: Apache-2.0
"""The deep module paths of ROS 2 (``launch.actions.execute_process``) over fewer files."""
from importlib.machinery import ModuleSpec
import re
import sys
from types import ModuleType
from typing import Dict, Iterable, NoReturn, Optional, Tuple

_BEFORE_WORD = re.compile('(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])')
_modules: Dict[str, Tuple[str, ...]] = {}


class _AliasFinder:
    """Finds what :func:`alias_submodules` announced; real files come first on the meta path."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> Optional[ModuleSpec]:
        return ModuleSpec(name, _AliasFinder) if name in _modules else None  # type: ignore

    @staticmethod
    def create_module(spec: ModuleSpec) -> None:
        return None

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        package = sys.modules[module.__name__.rpartition('.')[0]]
        for name in _modules[module.__name__]:
            setattr(module, name, getattr(package, name))


sys.meta_path.append(_AliasFinder)


def alias_submodules(package: str, names: Iterable[str], **special: Tuple[str, ...]) -> None:
    """
    Make ``package.execute_process`` importable for a class ``ExecuteProcess`` of ``package``.

    :param special: modules whose name or content doesn't follow from a class's name.
    """
    for name in names:
        if name[0].isupper():
            _modules[f"{package}.{_BEFORE_WORD.sub('_', name).lower()}"] = (name,)
    for module, content in special.items():
        _modules[f'{package}.{module}'] = content


def missing(module: str, name: str) -> NoReturn:
    """
    Refuse a name that the embedded default lacks; for a module's ``__getattr__``.

    :raises ImportError: for a name of ROS 2's: of an AttributeError, an import statement
        wouldn't show the text.
    :raises AttributeError: for any other.
    """
    if name in ('LifecycleTransition', 'ROSTimer', 'RosTimer', 'SetUseSimTime'):
        raise ImportError(
            f'{module}.{name} is not part of the embedded default: install ROS 2 '
            '(https://docs.ros.org/en/jazzy/Installation.html) and use that instead')
    raise AttributeError(f"module '{module}' has no attribute '{name}'")
