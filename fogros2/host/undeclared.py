# SPDX-License-Identifier: Apache-2.0
"""
Python packages that nodes import, that the robot has from pip, and that nothing declares.

``imports`` reads the code of workspaces and executes none of it; ``undeclared`` decides, pure.
"""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
import functools
from importlib import metadata
from pathlib import Path
import re
import sys
from typing import Optional
import warnings

from fogros2.host import dependencies, locked, wheels
from fogros2.host.workspace import run_dependencies, Workspace, written_paths
from fogros2.model import MachineSpec
from fogros2.report import Warned

#: Where a top-level module stands in the list of a distribution's files.
_MODULE = re.compile(r'^(\w+)(?:/__init__\.py|(?:\.[\w-]+)*\.(?:py|so)),', re.MULTILINE)
#: The names in a line that may import something.
_IMPORT = re.compile(r'(?:^|[;:])[ \t]*(?:from +\w+|import .+)', re.MULTILINE)
#: Modules may lack what is imported where one of these is caught.
_CAUGHT = {'ImportError', 'ModuleNotFoundError', 'Exception', 'BaseException'}
#: Below a module, and not for its nodes; a development install has the first.
_SKIPPED = {'setup.py', 'test', 'tests'}


def warning(
    spec: MachineSpec, chain: Sequence[Workspace], packages: Collection[str],
    prefixes: Iterable[str], shown: Sequence[str],
) -> Optional[Warned]:
    """
    Return the warning that a machine may lack Python packages, None where it lacks none.

    :param chain: workspaces that travel.
    :param packages: those of the nodes that will run there.
    :param prefixes: where the robot's ROS packages are.
    :param shown: folders of this computer that the machine has too.
    """
    if not chain:
        return None
    names = {*map(locked.name_of, spec.pip), *dependencies.OURS, *wheels.names()}
    pip = {module: name for module, name in from_pip(
        (*shown, *(str(space.root) for space in chain))).items() if name not in names}
    imported = imports(chain, packages, frozenset(pip))
    needs = undeclared(imported, pip, declared(
        (*dependencies.keys(chain, packages), *spec.apt), prefixes)) if any(
            imported.values()) else {}
    if not needs:
        return None
    modules = sorted(set().union(*needs.values()))
    return Warned(
        spec.name, f"node packages {str([*needs])[1:-1]} import {str(modules)[1:-1]}, which this "
        f"robot has from pip and no package.xml declares: machine '{spec.name}' may lack them",
        f'add pip={[*spec.pip, *sorted({pip[module] for module in modules})]} to machine '
        f"'{spec.name}'")


def undeclared(
    imported: Mapping[str, Collection[str]], pip: Mapping[str, str], keys: Iterable[str],
) -> dict[str, set[str]]:
    """
    Return the modules of pip that each package imports and nothing declares.

    A key declares a module by its name or by its distribution's, with ``python3-`` or without.

    :param imported: top-level modules by package, ``pip`` distributions by module.

    >>> undeclared({'a': {'cv2', 'scipy', 'torch'}},
    ...            {'cv2': 'opencv-python', 'scipy': 'scipy', 'torch': 'torch'},
    ...            ['python3-opencv', 'python3-scipy-pip'])
    {'a': {'torch'}}
    """
    plain = {re.sub('^python3?-|-pip$', '', locked.name_of(key)) for key in keys}
    lacking = {module for module, name in pip.items() if plain.isdisjoint({
        re.sub('^python3?-', '', name), re.sub('-(python|contrib|headless)', '', name),
        locked.name_of(module)})}
    return {package: lacking & {*modules} for package, modules in sorted(imported.items())
            if lacking & {*modules}}


def imports(
    chain: Iterable[Workspace], packages: Collection[str], modules: frozenset[str],
) -> dict[str, set[str]]:
    """
    Return the top-level modules that packages of workspaces import, without their own modules.

    :param packages: packages of the nodes; with the packages that they import; none for all.
    :param modules: the modules to look for.
    """
    by_package: dict[str, set[str]] = {}
    for space in chain:
        for name, path in _code(space):
            by_package.setdefault(name, set()).update(*(
                _imported(file, modules) for file in (path, *path.rglob('*'))
                if file.is_file() and _SKIPPED.isdisjoint(file.relative_to(path.parent).parts)))
    reached, todo = set[str](), {*(packages or by_package)} & {*by_package}
    while todo:
        reached |= todo
        todo = set().union(*(by_package[name] for name in todo)) & {*by_package} - reached
    return {name: by_package[name] & modules - {*by_package} for name in reached}


def _code(space: Workspace) -> Iterator[tuple[str, Path]]:
    """Yield the Python modules of an install space, and the folder of each package's programs."""
    for prefix in dict.fromkeys(space.installed.values()):
        for site in prefix.glob('lib/python3*/*-packages'):
            links = [*site.glob('*.pth'), *site.glob('*.egg-link')]
            for folder in (site, *(path for link in links for path in written_paths(link))):
                yield from ((path.stem, path) for path in folder.iterdir()
                            if path.suffix == '.py' or (path / '__init__.py').is_file())
    yield from ((name, prefix / 'lib' / name) for name, prefix in space.installed.items())


def _imported(file: Path, modules: frozenset[str]) -> set[str]:
    """
    Return what a file may import, and of some modules those that it does import.

    A file that is no Python, or cannot be read, imports nothing.
    """
    try:
        with file.open('rb') as opened, warnings.catch_warnings():
            first = opened.readline(200)
            if file.suffix != '.py' and not (first.startswith(b'#!') and b'python' in first):
                return set()
            text = first + opened.read()
            words = {*re.findall(r'\w+', ' '.join(_IMPORT.findall(text.decode('latin-1'))))}
            if words.isdisjoint(modules):
                return words  # parsing takes many times as long
            warnings.simplefilter('ignore')
            return words - modules | {*_statements(ast.parse(text).body)}
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return set()


def _statements(body: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the top-level names of what statements import, unless they can do without."""
    for node in body:
        if isinstance(node, ast.Import):
            yield from (alias.name.partition('.')[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition('.')[0]
        elif isinstance(node, ast.If) and 'TYPE_CHECKING' in ast.unparse(node.test):
            yield from _statements(node.orelse)
        elif not isinstance(node, ast.Try) or not any(
                handler.type is None or _CAUGHT & {*re.findall(r'\w+', ast.unparse(handler.type))}
                for handler in node.handlers):
            for field in ('body', 'orelse', 'finalbody', 'handlers', 'cases'):
                yield from _statements(getattr(node, field, ()))


@functools.lru_cache(maxsize=8)
def from_pip(but: tuple[str, ...]) -> Mapping[str, str]:
    """Return the distributions of modules that pip or uv installed, ``but`` in some folders."""
    distributions: dict[str, str] = {}
    for one in metadata.distributions():
        if (one.read_text('INSTALLER') or '').strip() in ('pip', 'uv') and not any(
                Path(str(one.locate_file(''))).is_relative_to(folder) for folder in but):
            modules = {*_MODULE.findall(one.read_text('RECORD') or '')} - sys.stdlib_module_names
            distributions = {**dict.fromkeys(modules, locked.name_of(one.name)), **distributions}
    return distributions


def declared(keys: Iterable[str], prefixes: Iterable[str]) -> set[str]:
    """Return keys, and what the ROS packages among them declare in turn."""
    names, todo = set[str](), {*keys}
    while todo:
        names |= todo
        todo = set().union(*(run_dependencies(Path(prefix, 'share', key, 'package.xml'))
                             for key in todo for prefix in prefixes)) - names
    return names
