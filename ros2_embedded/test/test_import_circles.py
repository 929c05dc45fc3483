# SPDX-License-Identifier: Apache-2.0
"""No module of the embedded default needs itself, whatever an import is for."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ('launch', 'launch_ros', 'launch_xml', 'launch_yaml', 'ros2cli')


def modules():
    """Return the file of each module by its name."""
    files = (path for package in PACKAGES for path in (ROOT / package).rglob('*.py'))
    return {'.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__'): path
            for path in files}


def imported(name, path, known):
    """Yield the modules that a module imports: at its top, in functions, and for types only."""
    package = name if path.name == '__init__.py' else name.rpartition('.')[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = '.'.join(package.split('.')[:len(package.split('.')) + 1 - node.level])
            base = '.'.join(filter(None, (above if node.level else '', node.module)))
            found = [f'{base}.{alias.name}' for alias in node.names]
        else:
            continue
        for other in found:
            while other and other not in known:
                other = other.rpartition('.')[0]
            if other and other != name:
                yield other


def test_no_circle_of_imports():
    known = modules()
    assert {'launch.actions', 'launch_ros._parsing', 'ros2cli.cli'} <= {*known}
    TopologicalSorter({name: {*imported(name, path, known)}
                       for name, path in known.items()}).prepare()
