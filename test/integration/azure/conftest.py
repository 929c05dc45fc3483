# SPDX-License-Identifier: Apache-2.0
"""A robot beside Azure in a box: launches there know of Azure's API alone."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import shutil
import subprocess
from typing import Any
import uuid

import pytest

from fogros2.waiting import wait_until
from rigs.azure.box import AzureBox
from rigs.launched import Launched, launching, ros2


class Robot:
    """
    A robot whose user has a subscription at the box's Azure.

    :param folder: holds its home.
    :param start: starts launches that end with the test.
    """

    def __init__(self, box: AzureBox, folder: Path, start: Any) -> None:
        self.box = box
        self.home = folder
        self._start = start
        self.variables = {
            **box.environment(), 'FOGROS2_AWS_CHECKIP': box.checkip,
            'HOME': str(folder), 'ROS_LOG_DIR': str(folder / 'log')}

    def environment(self, **variables: str) -> dict[str, str]:
        return {**os.environ, **self.variables, **variables}

    def launch(self, *words: str, **variables: str) -> Launched:
        """Start ``ros2 launch`` on the robot."""
        started: Launched = self._start(*words, environment=self.environment(**variables),
                                        prefix=self.box.on_robot([]))
        return started

    def ros2(self, *words: str, timeout: float = 60.0, **variables: str,
             ) -> subprocess.CompletedProcess[str]:
        """Run ``ros2`` on the robot."""
        return ros2(*words, environment=self.environment(**variables), timeout=timeout,
                    prefix=self.box.on_robot([]))

    def groups(self) -> list[str]:
        """Return the resource groups that somebody pays for."""
        return list(self.box.things()['groups'])

    def write(self, name: str, text: str) -> str:
        """Write a launch file and return its path."""
        path = self.home / name
        path.write_text(text)
        return str(path)


@pytest.fixture(scope='session')
def box(engine: str) -> Iterator[AzureBox]:
    """Open a box for all tests of this folder."""
    if shutil.which('ros2') is None:
        pytest.skip('needs ros2 on PATH')
    if os.geteuid() != 0:
        pytest.skip("needs root itself: sudo, the way into the robot's network, takes no Ctrl-C")
    for module in ('azure.identity', 'azure.mgmt.compute', 'azure.mgmt.network', 'werkzeug'):
        pytest.importorskip(module, reason=f'needs {module}')
    with AzureBox() as box:
        yield box


@pytest.fixture
def robot(box: AzureBox, tmp_path: Path) -> Iterator[Robot]:
    """Yield a robot; when the test ends, nothing that somebody would pay for is left."""
    box.heal()
    box.forget_calls()
    box.set_boot_delay(0.0)
    box.set_rights(owner=True)
    with launching() as start:
        robot = Robot(box, tmp_path, start)
        yield robot
    left = robot.groups()
    box.clear()
    wait_until(lambda: not robot.groups() and not box.alive(), timeout=20,
               what='groups to be deleted')
    assert not left, f'left at Azure: {left}'


@pytest.fixture
def name() -> str:
    """Return a name that no other machine has."""
    return f'fogt-{uuid.uuid4().hex[:6]}'
