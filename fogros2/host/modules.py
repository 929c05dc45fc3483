# SPDX-License-Identifier: Apache-2.0
"""
Python modules that some of our programs need besides ROS 2, and their installation on a machine.

They go into a folder that only these programs search, so that no other program finds another NumPy
than it was built for. The robot sends its own modules if they run on the machine. Otherwise the
machine installs them from its package index, in versions that are pinned with hashes. apt is no
alternative: Ubuntu 24.04 has PyAV 11, which does not support colour ranges.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import functools
import hashlib
from importlib import metadata
import importlib.util
import json
import platform
import re
import shlex
import sys
from typing import Any, Optional

from fogros2 import plugin_system, untrusted
from fogros2.errors import PrerequisiteError
from fogros2.host import locked
from fogros2.host.installer import among_nodes
from fogros2.host.wheels import libc_for, runs_on
from fogros2.model import Command, NodeSpec


@dataclasses.dataclass(frozen=True)
class Module:
    """
    A Python module that is not part of ROS 2.

    :param distributions: distributions that contain it; the first is the one to install.
    :param oldest: first numbers of the oldest usable version.
    """

    name: str
    distributions: tuple[str, ...]
    oldest: tuple[int, ...] = ()

    @property
    def requirement(self) -> str:
        """The requirement for pip."""
        version = '.'.join(map(str, self.oldest))
        return f'{self.distributions[0]}>={version}' if version else self.distributions[0]


#: What nodes that handle images or points need.
NUMPY = Module('numpy', ('numpy',))
OPENCV = Module('cv2', (
    'opencv-python-headless', 'opencv-contrib-python-headless', 'opencv-python',
    'opencv-contrib-python'))
#: Group of entry points: by the name of a ROS package, the modules that its executables need.
GROUP = 'fogros2.modules'

#: Imports each module, because an installed module may lack a shared library.
_ASK = """\
import importlib, json, os, platform, re, sys
from importlib import metadata
def version(module, names):
    if hasattr(module, '__version__'):
        return module.__version__
    for name in names:
        try:
            return metadata.version(name)
        except metadata.PackageNotFoundError:
            pass
    return ''
# ONNX Runtime would tell Microsoft that it was imported
os.environ.setdefault('ORT_DISABLE_TELEMETRY', '1')
missing = {}
for name, names, oldest in json.loads(sys.argv[1]):
    try:
        module = importlib.import_module(name)
        if oldest and [int(n) for n in re.findall(
                '[0-9]+', version(module, names))[:len(oldest)]] < oldest:
            missing[name] = ''
    except Exception as error:
        absent = isinstance(error, ModuleNotFoundError) and error.name == name
        missing[name] = '' if absent else str(error)[:200]
libc = ' '.join(platform.libc_ver())
print(json.dumps([sys.version_info[:2], platform.machine(), libc, missing]))
"""
@dataclasses.dataclass(frozen=True)
class Answer:
    """
    The Python of a machine's nodes, and the modules that it lacks.

    :param architecture: in the form of ``uname -m``.
    :param libc: such as ``glibc 2.36``.
    :param missing: names of modules that cannot be imported, or are too old.
    :param broken: errors of installed modules, such as a missing shared library.
    """

    python: tuple[int, int]
    architecture: str
    libc: str
    missing: tuple[str, ...]
    broken: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Copy:
    """
    Modules of this computer that run on a machine.

    :param entries: by folder with modules: names of the entries that belong to the modules.
    :param versions: names and versions of the distributions.
    """

    entries: Mapping[str, tuple[str, ...]]
    versions: tuple[str, ...]


@functools.cache
def _needs() -> Mapping[tuple[str, str], Sequence[Module]]:
    return {(package, executable): needed for package in plugin_system.names(GROUP)
            for executable, needed in plugin_system.load(GROUP, package).items()}


@functools.cache
def known() -> Mapping[str, Module]:
    """Return the modules that any program needs, by name."""
    return {module.name: module for needed in _needs().values() for module in needed}


def needed_by(programs: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    """Return the names of the modules that (package, executable) pairs need, sorted."""
    return tuple(sorted({
        module.name for program in programs for module in _needs().get(program, ())}))


def lacking_here(names: Iterable[str]) -> list[Module]:
    """Return the modules that this Python lacks or has too old; do not import them."""
    return [module for module in map(known().__getitem__, names)
            if importlib.util.find_spec(module.name) is None or _too_old(module)]


def _too_old(module: Module) -> bool:
    distribution = next(filter(None, map(_installed, module.distributions)), None)
    if distribution is None:
        return False  # installed without a version
    numbers = map(int, re.findall('[0-9]+', distribution.version)[:len(module.oldest)])
    return tuple(numbers) < module.oldest


def ask(
    names: Iterable[str], environment: Mapping[str, str], setup: Sequence[str], site: str = '',
) -> Command:
    """
    Return the command that looks for modules, for ``answer``.

    :param names: names of the modules.
    :param environment: variables of nodes on the machine; ``setup`` has scripts to source.
    :param site: an additional folder, which Python searches first.
    """
    words = ['python3', '-c', _ASK, json.dumps([
        (one.name, one.distributions, one.oldest) for one in map(known().__getitem__, names)])]
    return among_nodes(
        environment, setup, f'{_path([site]) if site else ""}exec {shlex.join(words)}',
        'look for Python modules')


def answer(output: str) -> Answer:
    """
    Parse the output of ``ask``.

    :raises PrerequisiteError: the machine's nodes have no Python.
    """
    try:
        (major, minor), architecture, libc, missing = untrusted.parsed(
            output.strip().splitlines()[-1], list[Any])
        untrusted.checked([major, minor], list[int])
        untrusted.checked([architecture, libc], list[str])
        untrusted.checked(missing, dict[str, str])
        if not missing.keys() <= known().keys():
            raise untrusted.InvalidMessage('it names modules that were not asked for')
        return Answer((major, minor), architecture, libc, tuple(missing),
                      tuple(filter(None, missing.values())))
    except (ValueError, LookupError, TypeError) as error:
        raise PrerequisiteError(
            f'no Python of the machine could list its modules: {output[-200:]!r}',
            'is python3 there at least 3.10, and does a login there print nothing?') from error


def copy(facts: Answer) -> Optional[Copy]:
    """Return the missing modules from this Python, None if they would not run there."""
    if facts.architecture != platform.machine():
        return None
    entries: dict[str, set[str]] = {}
    versions = []
    for name in facts.missing:
        distribution = next(filter(None, map(_installed, known()[name].distributions)), None)
        if distribution is None or not _runs(distribution, facts):
            return None
        # The other files are programs in a bin folder.
        entries.setdefault(str(distribution.locate_file('')), set()).update(
            file.parts[0] for file in distribution.files or () if file.parts[0] != '..')
        versions.append(f'{distribution.name} {distribution.version}')
    return Copy({folder: tuple(sorted(names)) for folder, names in entries.items()},
                tuple(versions))


def _installed(name: str) -> Optional[metadata.Distribution]:
    try:
        return metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return None


def _runs(distribution: metadata.Distribution, facts: Answer) -> bool:
    """Return whether an installed distribution runs on a machine with this processor."""
    tags = [tag.split('-') for tag in re.findall(
        r'^Tag: (\S+)$', distribution.read_text('WHEEL') or '', re.MULTILINE)]
    if not tags:
        return False  # not from a wheel: it may need libraries of this computer
    # It is for this version of Python, for the tag's version and later ones, or for any version.
    least = re.fullmatch(r'(?:cp|py)(\d)(\d*)', tags[0][0])
    stable = tags[0][1] in ('abi3', 'none') and least is not None and facts.python >= (
        int(least[1]), int(least[2] or 0))
    if not stable and facts.python != sys.version_info[:2]:
        return False
    wheel = f"x-{'.'.join(tag[2] for tag in tags)}.whl"
    return runs_on(libc_for([wheel]), facts.libc)


def folder(home: str, facts: Answer, versions: Sequence[str]) -> str:
    """
    Return the folder of modules on a machine; equal for equal modules.

    :param home: home of the login user.
    :param versions: names and versions of the modules.
    """
    need = json.dumps([facts.python, facts.missing, list(versions)])
    return (f'{home}/.local/share/fogros2/'
            f'modules-{hashlib.sha256(need.encode()).hexdigest()[:16]}')


def pinned(missing: Iterable[str]) -> list[str]:
    """
    Return the lines of a requirements file for modules from an index.

    :raises PrerequisiteError: a module is not pinned.
    """
    return locked.requirements(known()[name].distributions[0] for name in missing)


def fitted(node: NodeSpec, places: Mapping[str, str]) -> NodeSpec:
    """
    Return a node whose Python finds the modules that it needs.

    :param places: folders by module, '' for modules that the machine has itself.
    """
    needed = needed_by([(node.package, node.executable)])
    sites = dict.fromkeys(f'{places[name]}/site' for name in needed if places.get(name))
    if not sites or node.shell:
        return node
    # Searched first, because the machine's own version may be too old.
    return dataclasses.replace(node, prefix=(
        *node.prefix, 'sh', '-c', _path(sites) + 'exec "$@"', 'sh'))


def _path(sites: Iterable[str]) -> str:
    path = shlex.quote(':'.join(sites))
    return f'export PYTHONPATH={path}${{PYTHONPATH:+:$PYTHONPATH}}\n'
