# SPDX-License-Identifier: Apache-2.0
"""
What nodes need on a machine beyond ROS 2, as a launch file names it: apt and pip packages.

apt's go where apt puts them. pip's go into a folder of their own that Python looks into last, so
that they can replace nothing of the system's, of ROS 2's or ours (PEP 668).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import hashlib
import json
import re
import shlex

from fogros2 import modules, plan
from fogros2.errors import ConfigurationError
from fogros2.host import HostFacts
from fogros2.model import Command, MachineSpec

#: Packages that only this project's own wheels may bring, and the modules in them.
OURS = ('fogros2', 'fogros2-examples', 'fogros2-monitor', 'image-transport-h264', 'ros2-embedded',
        'ros2fog-cli')
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
#: Python executes it as it starts. The system's module of this name, if any, follows.
_LAST_IN_PATH = """\
import importlib.util, os, site, sys
from importlib.machinery import PathFinder
_here = os.path.dirname(os.path.abspath(__file__))
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
    if re.sub('[-_.]+', '-', found[1]).lower() in OURS:
        raise ConfigurationError(f"pip: '{found[1]}' is part of FogROS2, which brings it itself",
                                 'leave it out')
    return requirement


def missing(names: Iterable[str]) -> Command:
    """Return the command that prints which Debian packages a machine lacks."""
    return Command(('sh', '-c', _MISSING, 'sh', *names), what='look for apt packages')


@dataclasses.dataclass(frozen=True)
class PipFolder:
    """
    A folder on a machine with what pip was asked for.

    :param path: the same for the same requirements, so that they are installed once.
    """

    path: str
    requirements: tuple[str, ...]

    @classmethod
    def of(cls, spec: MachineSpec, facts: HostFacts) -> PipFolder:
        """Return a machine's folder, below the login user's home."""
        need = json.dumps([sorted(spec.pip), *(python.version for python in facts.pythons)])
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
        script = modules.PIP.format(folder=shlex.quote(self.path)) + (
            f'"$@" {shlex.join(self.requirements)}\n'
            'rm -rf pip\n'
            f'for name in {names}; do [ ! -e "site/$name" ] || {{\n'
            "    echo \"one of the packages brings '$name', which is part of FogROS2\" >&2\n"
            '    rm -rf site; exit 1; }\n'
            'done\n'
            f'mkdir -p last\nprintf %s {shlex.quote(_LAST_IN_PATH)} >last/sitecustomize.py\n'
            ': >complete\n')
        return modules.among_nodes(
            plan.extended(environment, given), setup, script, 'install Python packages')
