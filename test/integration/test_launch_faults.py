# SPDX-License-Identifier: Apache-2.0
"""Signals to ``ros2 launch`` in every step of a deployment: whatever happens, nothing is left."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
import pty
import shutil
import signal
import subprocess
import termios
import uuid

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.store import Store
from fogros2.waiting import wait_until
from rigs.launched import launching, ROS2, WITH_SIGINT

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

#: Other runs of these tests may be under way on the same computer.
NAME = f'fault-{uuid.uuid4().hex[:6]}'

LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen'),
    ])
"""

#: What a launch prints as a step begins, and at last when messages arrive.
CREATE, VPN, RUNNING = f'{NAME}: machine ...', f'{NAME}: VPN ...', 'I heard'


@pytest.fixture
def write(tmp_path, cloud_network):
    def write():
        path = tmp_path / 'planner.launch.py'
        path.write_text(LAUNCH.format(name=NAME, network=cloud_network))
        return str(path)
    return write


@pytest.fixture
def launched(write):
    with launching() as start:
        yield lambda: start('--debug', write())


# launch/test_signals.py has all signals
def test_a_signal_takes_everything_back(launched):
    """A second one does not stop the way back."""
    launch = launched()
    launch.wait_for(VPN)
    for _ in range(2):
        launch.interrupt()
        launch.wait_for('SIGINT')
    code = launch.ended()
    assert code in (0, 1) and 'Traceback' not in launch.text, launch.text


def own_terminal() -> None:
    os.setsid()
    fcntl.ioctl(1, termios.TIOCSCTTY, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)


# test_runtime_console.py has all kinds of screens
@pytest.mark.parametrize('output', ['terminal', 'unread pipe'])
def test_closed_output_takes_everything_back(write, request, output):
    """A closed terminal also sends SIGHUP; `| less` does not read until it is asked to."""
    terminal = output == 'terminal'
    if terminal:
        request.getfixturevalue('root_at_login')
    reader, writer = pty.openpty() if terminal else os.pipe()
    child = subprocess.Popen(
        [*(() if terminal else WITH_SIGINT), ROS2, 'launch', '--debug', write()],
        stdin=writer, stdout=writer, stderr=writer,
        preexec_fn=own_terminal if terminal else None)
    os.close(writer)
    lines = os.fdopen(reader, 'rb')
    try:
        next(line for line in lines if RUNNING.encode() in line)
        child.send_signal(signal.SIGINT)
        if terminal:
            next(line for line in lines if b'SIGINT' in line)
            lines.close()
        assert child.wait(60) in (0, 1)
    finally:
        lines.close()
        end_group(child.pid)
        child.wait(60)
    assert containers() == [] and not Store().exists(NAME)


def test_full_disk_takes_everything_back(launched, monkeypatch, tmp_path):
    disk = tmp_path / 'small'
    disk.mkdir()
    if process.run(Command(('mount', '-t', 'tmpfs', '-o', 'size=1m,mode=1777', 'tmpfs',
                            str(disk)), sudo=True), timeout=60.0, check=False).returncode != 0:
        pytest.skip('needs the right to mount')
    try:
        for variable in ('ROS_LOG_DIR', 'FOGROS2_STATE_HOME', 'TMPDIR'):
            monkeypatch.setenv(variable, str(disk))
        launch = launched()
        launch.wait_for(RUNNING)
        fill(disk)
        launch.interrupt()
        assert launch.ended() in (0, 1) and 'Logging error' not in launch.text, launch.text
        assert containers() == [] and not Store().exists(NAME)
    finally:
        process.run(Command(('umount', '-l', str(disk)), sudo=True), timeout=60.0)


def fill(disk: Path) -> None:
    """Leave no byte of a disk."""
    with open(disk / 'all', 'wb', buffering=0) as file:
        for size in (4096, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(b'x' * size)


# test_volumes.py kills one with an agent; benchmarks/chaos.py kills at any time
def test_a_launch_killed_early_leaves_nothing_for_good(launched):
    launch = launched()
    launch.wait_for(CREATE)
    launch.child.kill()
    launch.ended()
    # orphaned robot nodes are the user's to end, as with any launch that was killed
    end_group(launch.child.pid)
    # it may have had no machine yet; an engine may still be making one
    wait_until(lambda: fog('delete', NAME, '--yes') is not None and not containers(),
               timeout=60, what='ros2 fog delete')
    assert fog('gc') == 0


def end_group(group: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def containers() -> list[str]:
    # root's, and as a user without sudo the engine would leave a process of its own behind
    return process.run(
        Command(('podman', 'ps', '-aq', '--filter', f'name=fogros2-{NAME}'), sudo=True),
        timeout=30.0).stdout.split()


def fog(*words: str) -> int:
    return subprocess.run(['ros2', 'fog', *words], capture_output=True, timeout=60).returncode
