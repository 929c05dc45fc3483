# SPDX-License-Identifier: Apache-2.0
"""
Name what nodes need besides ROS 2: packages in launch files, and rosdep keys.

The keys are the packages of the launch's nodes, and what the sent packages declare
(``exec_depend``); of workspaces that are built on the machine, all that their packages declare.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
import re

from fogros2.errors import ConfigurationError
from fogros2.host import locked
from fogros2.host.workspace import dependencies, run_dependencies, Workspace
from fogros2.plugin_system import own_packages

#: Distributions that only this project's own wheels may install, and their modules.
OURS = tuple(locked.name_of(name) for name in (*own_packages(), 'ros2_embedded'))
#: Name of a Debian package, with an optional architecture and version.
_APT = re.compile(r'[a-z0-9][a-z0-9+.-]+(:[a-z0-9-]+)?(=[A-Za-z0-9.+:~-]+)?')
#: A requirement begins with a name (PEP 508): neither an option nor a URL.
_PIP = re.compile(r'([A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9])?)\s*($|[\[@<>=!~;(,])')


def check_apt(name: str) -> str:
    """
    Check and return the name of a Debian package.

    :raises ConfigurationError: the name is invalid.
    """
    if not _APT.fullmatch(name):
        raise ConfigurationError(f'apt: {name!r} is no name of a Debian package',
                                 "such as 'libzbar0', one text for each package")
    return name


def check_pip(requirement: str) -> str:
    """
    Check and return a requirement for pip.

    :raises ConfigurationError: it names no package, or a package of this project.
    """
    match = _PIP.match(requirement)
    if match is None:
        raise ConfigurationError(f'pip: {requirement!r} names no Python package',
                                 "such as 'pyzbar>=0.1.9' or 'pyzbar @ https://...'")
    if locked.name_of(match[1]) in OURS:
        raise ConfigurationError(f"pip: '{match[1]}' is part of FogROS2, which brings it itself",
                                 'leave it out')
    return requirement


def keys(
    workspaces: Iterable[Workspace], packages: Iterable[str], built: Iterable[Path] = (),
) -> tuple[str, ...]:
    """
    Return the rosdep keys of what a machine needs besides the workspaces, sorted.

    What FogROS2's own packages need is sent with them (``modules``).

    :param packages: packages of the launch's nodes.
    :param built: roots of the workspaces that are built there.
    """
    own: set[str] = set()
    names = {*packages, *dependencies(*built)}
    for workspace in workspaces:
        own |= set(workspace.packages)
        for name, prefix in workspace.installed.items():
            if name not in own_packages():
                names |= run_dependencies(prefix / 'share' / name / 'package.xml')
    return tuple(sorted(names - own - {''}))


def outside(names: Iterable[str], prefixes: Iterable[str]) -> tuple[str, ...]:
    """Return the keys without the ROS packages below some prefixes of this computer."""
    folders = [Path(prefix, 'share/ament_index/resource_index/packages') for prefix in prefixes]
    return tuple(name for name in names
                 if not any((folder / name).exists() for folder in folders))
