# SPDX-License-Identifier: Apache-2.0
"""Check that the programs of nodes exist, before a machine is created for them."""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
import shlex
from typing import Optional

from fogros2.errors import did_you_mean, WorkspaceError
from fogros2.host import workspace


def check_program(
    package: str, executable: str, prefixes: Sequence[str], travelling: Optional[str] = None,
) -> None:
    """
    Check that a node's program is in the ament index of the robot, or in the workspace to send.

    :param prefixes: the robot's ament prefixes.
    :param travelling: the workspace to send, which need not be sourced.
    :raises WorkspaceError: no such package or executable; the hint names the nearest.
    """
    index = 'share/ament_index/resource_index/packages'
    prefixes = [*workspace.prefixes(travelling), *prefixes]
    for prefix in prefixes:
        if not Path(prefix, index, package).exists():
            continue
        folder = Path(prefix, 'lib', package)
        files = [p for p in folder.iterdir() if p.is_file()] if folder.is_dir() else []
        names = sorted(p.name for p in files if os.access(p, os.X_OK))
        if executable in names:
            return
        if (program := folder / executable) in files:
            raise WorkspaceError(f"'{program}' is not executable",
                                 f'chmod +x {shlex.quote(str(program))}')
        raise WorkspaceError(
            f"package '{package}' has no executable '{executable}'",
            _nearest(executable, names) or f'{folder} has none')
    source = workspace.inspect(travelling).sources.get(package) if travelling else None
    if source is not None:
        raise WorkspaceError(f"package '{package}' in {source} is not built",
                             f'run colcon build in {travelling}')
    packages = {
        path.name for prefix in prefixes if Path(prefix, index).is_dir()
        for path in Path(prefix, index).iterdir()}
    raise WorkspaceError(
        f"there is no package '{package}'",
        _nearest(package, sorted(packages)) or 'source the setup.bash of its workspace, or name '
        'that workspace with ros_workspace=')


def _nearest(name: str, names: Sequence[str]) -> str:
    return did_you_mean(name, names, None if len(names) <= 8 else '', cutoff=0.75)
