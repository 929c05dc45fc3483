# SPDX-License-Identifier: Apache-2.0
"""Run the router of the robot's nodes, for a middleware that needs one."""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path
import socket
import threading

from fogros2 import plan, process
from fogros2.dds import Router
from fogros2.errors import DdsError
from fogros2.model import Command
from fogros2.store import write_private

#: Number of machine addresses that the robot's router knows before any machine exists.
MACHINES = 32
#: Seconds before a router that ended is restarted.
PAUSE = 1.0
#: Starts a program and ends it when standard input is closed, so that no router outlives
#: a launch that was killed.
_RUN = """\
exec 3<&0 >&2
{ read -r _ <&3; kill $$; } &
exec 3<&- </dev/null "$0"
"""


def answers(host: str, port: int) -> bool:
    """Return whether something accepts connections at a TCP port of this computer."""
    try:
        socket.create_connection((host, port), timeout=0.5).close()
        return True
    except OSError:
        return False


class RobotRouter:
    """
    The router beside the robot's nodes; restarted when it ends.

    :param folder: directory for its configuration and its log.
    :param environment: the launch's environment variables.
    :raises DdsError: the router's program is not installed.
    """

    def __init__(self, router: Router, folder: Path, environment: Mapping[str, str]) -> None:
        programs = [path for prefix in plan.ament_prefixes(environment) if os.access(
            path := Path(prefix, 'lib', router.package, router.executable), os.X_OK)]
        if not programs:
            raise DdsError(
                f'{router.package} has no {router.executable}, which connects the nodes',
                f"sudo apt-get install ros-jazzy-{router.package.replace('_', '-')}")
        config = folder / 'router.json5'
        write_private(config, router.config.encode())
        self._log = folder / 'router.log'
        self._command = Command(('sh', '-c', _RUN, str(programs[0])),
                                what=f"run the robot's {router.executable}")
        self._environment = {**environment, router.variable: str(config)}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name='fog-router', daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            end, ours = os.pipe()
            with open(self._log, 'ab') as log:
                child = process.start(self._command, environment=self._environment, stdin=end,
                                      stderr=log.fileno())
            os.close(end)
            while child.poll() is None and not self._stop.wait(PAUSE / 5):
                pass
            process.end(child, sudo=False)
            os.close(ours)
            if child.stdout is not None:
                child.stdout.close()
            self._stop.wait(PAUSE)

    def close(self) -> None:
        """End the router."""
        self._stop.set()
        self._thread.join()
