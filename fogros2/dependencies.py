# SPDX-License-Identifier: Apache-2.0
"""
What nodes need on a machine beyond ROS 2: packages that launch files name, and rosdep keys.

The keys are what the travelling packages declare (``exec_depend``) and the packages of the
launch's nodes. apt's packages go where apt puts them. pip's go into a folder of their own that
Python looks into last, so that they can replace nothing of the system's, of ROS 2's or ours
(PEP 668).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import hashlib
import json
from pathlib import Path
import re
import shlex

from fogros2 import locked, modules, plan
from fogros2.errors import ConfigurationError
from fogros2.host import DISTRO, HostFacts
from fogros2.model import Command, MachineSpec
from fogros2.plugin_system import OWN_PACKAGES
from fogros2.workspace import run_dependencies, Workspace

#: Packages that only this project's own wheels may bring, and the modules in them.
OURS = tuple(locked.name_of(name) for name in (*OWN_PACKAGES, 'ros2_embedded'))
#: A package's name, with an architecture and a version where those are named.
_APT = re.compile(r'[a-z0-9][a-z0-9+.-]+(:[a-z0-9-]+)?(=[A-Za-z0-9.+:~-]+)?')
#: A requirement begins with a name (PEP 508): neither an option nor a bare address.
_PIP = re.compile(r'([A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?)\s*($|[\[@<>=!~;(,])')

_MISSING = """\
for name; do
    state=$(dpkg-query -W -f '${db:Status-Status} ${Version}' "${name%%=*}" 2>/dev/null) || state=
    case $name in
        *=*) [ "$state" = "installed ${name#*=}" ] || echo "$name" ;;
        *) [ "${state%% *}" = installed ] || echo "$name" ;;
    esac
done
"""
#: Prints the keys that are neither a ROS package there nor a Debian package of that very name.
_UNKNOWN = r"""
left=()
for key; do
    IFS=:
    for prefix in $AMENT_PREFIX_PATH; do
        [ ! -e "$prefix/share/ament_index/resource_index/packages/$key" ] || continue 2
    done
    left+=("$key")
done
[ ${#left[@]} != 0 ] || exit 0
# one call for all: each takes a hundredth of a second
there=" $(dpkg-query -W -f '${Package}=${db:Status-Status} ' "${left[@]}" 2>/dev/null) "
for key in "${left[@]}"; do
    [[ $there = *" $key=installed "* ]] || echo "$key"
done
"""
#: Exit status where rosdep itself is not there.
NO_ROSDEP = 4
#: rosdep downloads its lists once; it exits with 1 where one of the keys has no rule.
_RESOLVE = f"""\
command -v rosdep >/dev/null || exit {NO_ROSDEP}
""" + """\
if [ ! -e "${ROS_HOME:-$HOME/.ros}/rosdep/sources.cache/index" ]; then
    [ -n "$ROSDEP_SOURCE_PATH" ] || [ -e /etc/ros/rosdep/sources.list.d/20-default.list ] \\
        || sudo -n rosdep init >&2 || exit 3
    rosdep update --rosdistro "$distro" >&2 || exit 3
fi
rosdep resolve --rosdistro "$distro" "$@" || [ $? = 1 ]
"""
#: Python executes it as it starts. The system's module of this name, if any, follows.
_LAST_IN_PATH = """\
import importlib.util, os, site, sys
from importlib.machinery import PathFinder
_here = os.path.dirname(os.path.abspath(__file__))
if sys.base_prefix == '/usr' != sys.prefix:
    # an environment of the system's own Python sees what apt has installed
    sys.path.append('/usr/lib/python3/dist-packages')
site.addsitedir(os.path.join(os.path.dirname(_here), 'site'))
_next = PathFinder.find_spec('sitecustomize', [p for p in sys.path if os.path.abspath(p) != _here])
if _next is not None:
    _next.loader.exec_module(importlib.util.module_from_spec(_next))
"""


def check_apt(name: str) -> str:
    """
    Return the name of a Debian package.

    :raises ConfigurationError: it is none.
    """
    if not _APT.fullmatch(name):
        raise ConfigurationError(f'apt: {name!r} is no name of a Debian package',
                                 "such as 'libzbar0', one text for each package")
    return name


def check_pip(requirement: str) -> str:
    """
    Return a requirement as pip takes it.

    :raises ConfigurationError: it names no package, or one of ours.
    """
    found = _PIP.match(requirement)
    if found is None:
        raise ConfigurationError(f'pip: {requirement!r} names no Python package',
                                 "such as 'pyzbar>=0.1.9' or 'pyzbar @ https://...'")
    if locked.name_of(found[1]) in OURS:
        raise ConfigurationError(f"pip: '{found[1]}' is part of FogROS2, which brings it itself",
                                 'leave it out')
    return requirement


def keys(workspaces: Iterable[Workspace], packages: Iterable[str]) -> tuple[str, ...]:
    """
    Return the rosdep keys of what has to be on a machine beside workspaces, sorted.

    :param packages: those of the launch's nodes.
    """
    own: set[str] = set()
    found = set(packages)
    for workspace in workspaces:
        own |= set(workspace.packages)
        for name, prefix in workspace.installed.items():
            found |= run_dependencies(prefix / 'share' / name / 'package.xml')
    return tuple(sorted(found - own - {''}))


def outside(names: Iterable[str], prefixes: Iterable[str]) -> tuple[str, ...]:
    """Return the keys that are no ROS package below some prefixes of this computer."""
    folders = [Path(prefix, 'share/ament_index/resource_index/packages') for prefix in prefixes]
    return tuple(name for name in names
                 if not any((folder / name).exists() for folder in folders))


def rosdep_package(facts: HostFacts) -> str:
    """Return the Debian package that has rosdep."""
    return 'python3-rosdep2' if facts.system == 'debian' else 'python3-rosdep'


def unknown(
    names: Sequence[str], environment: Mapping[str, str], setup: Sequence[str],
) -> Command:
    """Return the command that prints the keys for which a machine may lack something."""
    return modules.among_nodes(
        environment, setup, f'set -- {shlex.join(names)}\n{_UNKNOWN}', 'look for dependencies')


def resolve(
    names: Sequence[str], environment: Mapping[str, str], setup: Sequence[str],
) -> Command:
    """Return the command whose output ``resolved`` reads."""
    return modules.among_nodes(
        environment, setup, f'distro={DISTRO}\nset -- {shlex.join(names)}\n{_RESOLVE}',
        'resolve rosdep keys')


def resolved(output: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    r"""
    Return the Debian packages and the pip packages that rosdep names.

    >>> resolved('#ROSDEP[a]\n#apt\nliba libb\n#ROSDEP[c]\n#pip\nc')
    (('liba', 'libb'), ('c',))
    """
    found: dict[str, list[str]] = {'apt': [], 'pip': []}
    installer = ''
    for line in output.splitlines():
        if line.startswith('#'):
            installer = line[1:].strip()
        elif installer in found:
            found[installer] += line.split()
    return tuple(dict.fromkeys(found['apt'])), tuple(dict.fromkeys(found['pip']))


def missing(names: Iterable[str]) -> Command:
    """Return the command that prints which Debian packages a machine lacks, each once."""
    return Command(('sh', '-c', _MISSING, 'sh', *dict.fromkeys(names)),
                   what='look for apt packages')


@dataclasses.dataclass(frozen=True)
class PipFolder:
    """
    A folder on a machine with what pip was asked for.

    :param path: the same for the same requirements, so that they are installed once.
    """

    path: str
    requirements: tuple[str, ...]

    @classmethod
    def of(
        cls, spec: MachineSpec, facts: HostFacts, names: Sequence[str] = (),
    ) -> PipFolder:
        """
        Return a machine's folder, below the login user's home.

        :param names: rosdep keys; some may be pip's.
        """
        need = json.dumps([sorted(spec.pip), sorted(names), sorted(spec.apt),
                           *(python.version for python in facts.pythons)])
        digits = hashlib.sha256(need.encode()).hexdigest()[:16]
        return cls(f'{facts.home}/.local/share/fogros2/pip-{digits}', spec.pip)

    def found_by(self, environment: Mapping[str, str]) -> dict[str, str]:
        """Return variables with which Python finds the packages, after all others."""
        own = f'{self.path}/last'
        before = environment.get('PYTHONPATH')
        return {**environment, 'PYTHONPATH': f'{before}:{own}' if before else own}

    @property
    def done(self) -> str:
        """The name among ``HostFacts.installed`` of a folder that is complete."""
        return self.path.rpartition('/')[2]

    def fill(
        self, environment: Mapping[str, str], given: Mapping[str, str], setup: Sequence[str],
    ) -> Command:
        """
        Return the command that installs the packages, one call of pip.

        :param environment: of nodes there, ``given`` the launch file's for the machine.
        """
        names = ' '.join(name.replace('-', '_') for name in OURS)
        script = modules.PIP.format(folder=shlex.quote(self.path)) if self.requirements else (
            f'set -e\nmkdir -p {shlex.quote(self.path)}\ncd {shlex.quote(self.path)}\n')
        script += (
            (f'"$@" {shlex.join(self.requirements)}\n' if self.requirements else '') +
            'rm -rf pip\n'
            f'for name in {names}; do [ ! -e "site/$name" ] || {{\n'
            "    echo \"one of the packages brings '$name', which is part of FogROS2\" >&2\n"
            '    rm -rf site; exit 1; }\n'
            'done\n'
            f'mkdir -p last\nprintf %s {shlex.quote(_LAST_IN_PATH)} >last/sitecustomize.py\n'
            ': >complete\n')
        return modules.among_nodes(
            plan.extended(environment, given), setup, script, 'install Python packages')
