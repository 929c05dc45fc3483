# SPDX-License-Identifier: Apache-2.0
"""ROS 2's deep module paths (``launch.actions.shutdown``), and errors for what isn't here."""
from importlib.machinery import ModuleSpec
import sys
from types import ModuleType

from embedded_default.lacking import LACKING

#: Modules whose names don't follow from a class or function in them.
_OTHERS = {
    'launch.actions.shutdown_action', 'launch.events.matchers',
    'launch.events.process.process_matchers', 'launch.substitutions.boolean_substitution',
    'launch.utilities.class_tools_impl', 'launch_ros.utilities.namespace_utils',
    'launch_ros.utilities.track_node_names'}


class _AliasFinder:
    """Finds modules that ROS 2 has for single classes; real files come first on the meta path."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        package, _, module = name.rpartition('.')
        if name.partition('.')[0] not in ('launch', 'launch_ros') or package not in sys.modules:
            return None
        wanted = module.removesuffix('_impl').replace('_', '')
        for lacked in LACKING.get(package, ()):
            if wanted == lacked.lower():
                getattr(sys.modules[package], lacked)  # raises
        # a copy: another thread that imports a module puts it there meanwhile
        if name in _OTHERS or any(wanted == known.replace('_', '').lower() and known != module
                                  for known in list(vars(sys.modules[package]))):
            return ModuleSpec(name, _AliasFinder)  # type: ignore[arg-type]
        return None

    @staticmethod
    def create_module(spec: ModuleSpec) -> None:
        return None

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        package = sys.modules[module.__name__.rpartition('.')[0]]
        vars(module).update((name, value) for name, value in list(vars(package).items())
                            if not name.startswith('__') or name == '__getattr__')


sys.meta_path.append(_AliasFinder)

