# SPDX-License-Identifier: Apache-2.0
"""Run the router of the robot's nodes, for a middleware that needs one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import os
from pathlib import Path
import socket

from fogros2 import plan, process
from fogros2.dds import Router, VARIABLES
from fogros2.errors import DdsError
from fogros2.model import Command
from fogros2.store import write_private

#: Number of machine addresses that the robot's router knows before any machine exists.
MACHINES = 32
#: Seconds before a router that ended is restarted.
PAUSE = 1.0
#: Runs a program again and again until standard input is closed, so that no router outlives a
#: launch that was killed. It is the first process of its group.
_RUN = """\
exec 3<&0 </dev/null
{ read -r _ <&3; kill 0; } &
exec 3<&-
while :; do "$0"; sleep "$1"; done
"""


def answers(host: str, port: int) -> bool:
    """Return whether something accepts connections at a TCP port of this computer."""
    try:
        socket.create_connection((host, port), timeout=0.5).close()
        return True
    except OSError:
        return False


def run(router: Router, folder: Path, environment: Mapping[str, str]) -> Callable[[], None]:
    """
    Run the router beside the robot's nodes, again when it ends; return what ends it.

    :param folder: directory for its configuration and its log.
    :param environment: the launch's environment variables; those of DDS are for nodes only.
    :raises DdsError: the router's program is not installed.
    """
    programs = [path for prefix in plan.ament_prefixes(environment) if os.access(
        path := Path(prefix, 'lib', router.package, router.executable), os.X_OK)]
    if not programs:
        raise DdsError(
            f'{router.package} has no {router.executable}, which connects the nodes',
            f"sudo apt-get install ros-jazzy-{router.package.replace('_', '-')}")
    config = folder / 'router.json5'
    write_private(config, router.config.encode())
    theirs, ours = os.pipe()
    with open(folder / 'router.log', 'ab') as log:
        child = process.start(
            Command(('sh', '-c', _RUN, str(programs[0]), f'{PAUSE:g}')), stdin=theirs,
            stdout=log.fileno(), stderr=log.fileno(),
            environment={
                **{name: value for name, value in environment.items() if name not in VARIABLES},
                router.variable: str(config)})
    os.close(theirs)

    def end() -> None:
        process.end(child, sudo=False)
        os.close(ours)

    return end
