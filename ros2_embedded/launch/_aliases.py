# SPDX-License-Identifier: Apache-2.0
"""The deep module paths of ROS 2 (``launch.actions.execute_process``) over fewer files."""
from importlib.machinery import ModuleSpec
import re
import sys
from types import ModuleType
from typing import Dict, Iterable, Optional, Tuple

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
