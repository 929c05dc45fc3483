# SPDX-License-Identifier: Apache-2.0
"""
What nodes that handle images import beyond ROS 2, and how a machine gets what it lacks of it.

That goes into a folder which these nodes alone look into, so that nothing else on the machine
finds another NumPy than it was built for. The robot's own modules travel where they run on the
machine as they are; else the machine asks its package index. Not apt: Ubuntu 24.04 has PyAV 11,
which can't be told a colour range.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import hashlib
from importlib import metadata
import importlib.util
import json
import platform
import re
import shlex
import sys
from typing import Optional

from fogros2.errors import PrerequisiteError
from fogros2.model import Command, NodeSpec
from fogros2.wheels import libc_for, runs_on


@dataclasses.dataclass(frozen=True)
class Module:
    """
    A Python module that isn't ROS 2's.

    :param distributions: those that have it; the first is the one to install.
    :param oldest: first number of the version that is needed at least.
    """

    name: str
    distributions: tuple[str, ...]
    oldest: int = 0


MODULES = (
    Module('numpy', ('numpy',)),
    # 14 makes nothing of depth images of a few pixels, and 11 knows no colour range
    Module('av', ('av',), 15),
    Module('cv2', ('opencv-python-headless', 'opencv-contrib-python-headless', 'opencv-python',
                   'opencv-contrib-python')),
)
#: Executables that need them, by package.
NEEDING: Mapping[str, frozenset[str]] = {
    'image_transport_h264': frozenset({'encoder', 'decoder'}),
    'fogros2_examples': frozenset({'camera', 'image_processor'}),
}

#: Imports each, as what is only found may lack a library.
_ASK = """\
import importlib, json, platform, sys
missing = []
for name, oldest in json.loads(sys.argv[1]):
    try:
        module = importlib.import_module(name)
        if oldest and int(module.__version__.split('.')[0]) < oldest:
            missing.append(name)
    except Exception:
        missing.append(name)
libc = ' '.join(platform.libc_ver())
print(json.dumps([sys.version_info[:2], platform.machine(), libc, missing]))
"""
_INSTALL = """\
mkdir -p {folder}
cd {folder}
rm -rf site
if python3 -m pip --version >/dev/null 2>&1; then
    set -- python3 -m pip
else
    python3 -m venv --clear pip
    set -- pip/bin/python -m pip
fi
"$@" install --quiet --no-deps --no-compile --disable-pip-version-check --target site {names}
rm -rf pip
"""


@dataclasses.dataclass(frozen=True)
class Answer:
    """
    What a machine says of the Python that its nodes run in.

    :param architecture: as ``uname -m`` has it.
    :param libc: such as ``glibc 2.36``.
    :param missing: names of modules that it can't import, or that are too old.
    """

    python: tuple[int, int]
    architecture: str
    libc: str
    missing: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Copy:
    """
    What of this computer runs on a machine as it is.

    :param folder: holds the modules, ``entries`` names those of its entries that belong to them.
    :param versions: of the distributions, each with its name.
    """

    folder: str
    entries: tuple[str, ...]
    versions: tuple[str, ...]


def needed_by(programs: Iterable[tuple[str, str]]) -> bool:
    """Return whether one of these (package, executable) pairs handles images."""
    return any(executable in NEEDING.get(package, ()) for package, executable in programs)


def lacking_here() -> list[Module]:
    """Return the modules that this Python hasn't got, or too old; imports none of them."""
    return [module for module in MODULES
            if importlib.util.find_spec(module.name) is None or _too_old(module)]


def _too_old(module: Module) -> bool:
    try:
        return module.oldest > 0 and int(
            metadata.version(module.distributions[0]).split('.')[0]) < module.oldest
    except (metadata.PackageNotFoundError, ValueError):
        return False  # it is there, in a way that says no version


def ask(environment: Mapping[str, str], setup: Sequence[str], site: str = '') -> Command:
    """
    Return the command whose output ``answer`` reads.

    :param environment: of nodes on the machine, ``setup`` the scripts sourced before they run.
    :param site: a folder to look into as well, before all others.
    """
    words = ['python3', '-c', _ASK, json.dumps([(m.name, m.oldest) for m in MODULES])]
    return _among_nodes(
        environment, setup, f'{_path(site)}exec {shlex.join(words)}' if site else
        f'exec {shlex.join(words)}', 'look for what images take')


def answer(output: str) -> Answer:
    """
    Return what a machine said.

    :raises PrerequisiteError: its nodes have no Python.
    """
    try:
        python, architecture, libc, missing = json.loads(output.strip().splitlines()[-1])
        return Answer((int(python[0]), int(python[1])), str(architecture), str(libc),
                      tuple(map(str, missing)))
    except (ValueError, LookupError, TypeError) as error:
        raise PrerequisiteError(f'no Python there says what it has: {output[-200:]!r}') from error


def copy(there: Answer) -> Optional[Copy]:
    """Return what a machine lacks, from this Python; None where it wouldn't run there."""
    if (there.python, there.architecture) != (sys.version_info[:2], platform.machine()):
        return None
    folder, entries, versions = '', set(), []
    for module in MODULES:
        if module.name in there.missing:
            found = next(filter(None, map(_installed, module.distributions)), None)
            if found is None or not runs_on(libc_for(_wheel_names(found)), there.libc):
                return None
            if folder not in ('', str(found.locate_file(''))):
                return None
            folder = str(found.locate_file(''))
            # the rest are programs, in a bin beside it
            entries |= {file.parts[0] for file in found.files or () if file.parts[0] != '..'}
            versions.append(f'{found.name} {found.version}')
    return Copy(folder, tuple(sorted(entries)), tuple(versions))


def _installed(name: str) -> Optional[metadata.Distribution]:
    try:
        return metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return None


def _wheel_names(found: metadata.Distribution) -> list[str]:
    """Return names of wheels that this was installed from, or one that runs here alone."""
    tags = re.findall(r'^Tag: (\S+)$', found.read_text('WHEEL') or '', re.MULTILINE)
    return ['-'.join(tags[0].split('-')[:2]) + '-' + '.'.join(t.split('-')[2] for t in tags)
            ] if tags else ['py3-none-linux']


def folder(home: str, there: Answer, versions: Sequence[str]) -> str:
    """
    Return where modules lie on a machine; the same for the same need.

    :param home: of the login user.
    :param versions: of what is put there, as far as they are known.
    """
    need = json.dumps([there.python, there.missing, list(versions)])
    return (f'{home}/.local/share/fogros2/'
            f'modules-{hashlib.sha256(need.encode()).hexdigest()[:16]}')


def install(
    environment: Mapping[str, str], setup: Sequence[str], target: str, missing: Sequence[str],
) -> Command:
    """Return what installs them from the machine's index, into ``target``/site."""
    names = [f'{m.distributions[0]}>={m.oldest}' for m in MODULES if m.name in missing]
    return _among_nodes(environment, setup, 'set -e\n' + _INSTALL.format(
        folder=shlex.quote(target), names=shlex.join(names)), 'install what images take')


def fitted(node: NodeSpec, target: str) -> NodeSpec:
    """Return a node that finds what is in ``target``/site, if it is one that handles images."""
    if not target or node.shell or not needed_by([(node.package, node.executable)]):
        return node
    # in front of what is there: that may be there and too old
    return dataclasses.replace(node, prefix=(
        *node.prefix, 'sh', '-c', _path(f'{target}/site') + 'exec "$@"', 'sh'))


def _path(site: str) -> str:
    return f'export PYTHONPATH={shlex.quote(site)}${{PYTHONPATH:+:$PYTHONPATH}}\n'


def _among_nodes(
    environment: Mapping[str, str], setup: Sequence[str], script: str, what: str,
) -> Command:
    """Return a command that runs a script as nodes run; a workspace may not be there yet."""
    lines = [f'[ ! -f {shlex.quote(path)} ] || . {shlex.quote(path)}' for path in setup]
    return Command(
        ('env', *(f'{name}={value}' for name, value in environment.items()), 'bash', '-c',
         '\n'.join([*lines, script])), what=what)
