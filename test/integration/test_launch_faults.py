# SPDX-License-Identifier: Apache-2.0
"""Signals to ``ros2 launch`` in every step of a deployment: whatever happens, nothing is left."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
import pty
import selectors
import shutil
import signal
import subprocess
import termios
import threading
import uuid

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.store import Store
from fogros2.waiting import wait_until

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
    machine = ContainerInstance(name='{name}', network='{network}', robot_timeout={timeout})
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen', respawn=True),
        Node(package='fogros2_examples', executable='listener', output='screen'),
    ])
"""

#: What a launch prints as a step begins, and at last when messages arrive.
STEPS = {
    'create': f'{NAME}: machine ...', 'vpn': f'{NAME}: VPN ...', 'running': 'I heard',
}


def own_group() -> None:
    # not a session: sudo's ticket is for the terminal's
    os.setpgrp()
    # a shell that starts tests in the background has SIGINT ignored
    signal.signal(signal.SIGINT, signal.default_int_handler)


def own_terminal() -> None:
    os.setsid()
    fcntl.ioctl(1, termios.TIOCSCTTY, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)


class Launched:
    """
    A ``ros2 launch`` process, its output read until ``deafen``.

    :param terminal: give it a terminal of its own instead of a pipe.
    """

    def __init__(self, path: Path, *, terminal: bool = False) -> None:
        self.said: list[str] = []
        reader, writer = pty.openpty() if terminal else os.pipe()
        self.child = subprocess.Popen(
            ['ros2', 'launch', '--debug', str(path)], stdin=writer if terminal else None,
            stdout=writer, stderr=writer, preexec_fn=own_terminal if terminal else own_group)
        os.close(writer)
        self._output = os.fdopen(reader, 'rb', buffering=0)
        self._deaf = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        rest = b''
        with selectors.DefaultSelector() as chosen, contextlib.suppress(OSError):
            chosen.register(self._output, selectors.EVENT_READ)
            while not self._deaf.is_set():
                if not chosen.select(0.05):
                    continue
                data = self._output.read(4096)
                if not data:
                    break
                *lines, rest = (rest + data).split(b'\n')
                self.said += [f'{line.decode(errors="replace")}\n' for line in lines]

    def deafen(self, *, close: bool) -> None:
        """Read no more of its output; ``close`` the terminal or the pipe."""
        self._deaf.set()
        self._reader.join(5)
        if close:
            self._output.close()

    def wait_for(self, words: str, timeout: float = 60.0) -> None:
        """Wait until a line with ``words`` came."""
        def there() -> bool:
            if any(words in line for line in list(self.said)):
                return True
            if self.child.poll() is not None:
                pytest.fail(f'the launch ended before {words!r}:\n{"".join(self.said)}')
            return False

        wait_until(there, timeout=timeout, what=repr(words), longest=0.005, interval=0.002)

    def ended(self, timeout: float = 60.0) -> int:
        """Return the exit status."""
        code = self.child.wait(timeout)
        self._reader.join(5)
        if not self._output.closed:
            self._output.close()
        return code


@pytest.fixture
def launched(tmp_path, cloud_network):
    started = []

    def start(timeout=120, **words):
        path = tmp_path / 'planner.launch.py'
        path.write_text(LAUNCH.format(name=NAME, network=cloud_network, timeout=timeout))
        started.append(Launched(path, **words))
        return started[-1]

    yield start
    for launch in started:
        if launch.child.poll() is None:
            os.killpg(launch.child.pid, signal.SIGKILL)
        launch.child.wait(60)


# launch/test_signals.py has all signals
def test_a_signal_takes_everything_back(launched):
    launch = launched()
    launch.wait_for(STEPS['vpn'])
    end_twice(launch, signal.SIGINT)


def end_twice(launch, number):
    """End a launch; a second signal does not stop the way back."""
    for _ in range(2):
        launch.child.send_signal(number)
        launch.wait_for(number.name)
    code = launch.ended()
    assert 'Traceback' not in ''.join(launch.said)
    assert code in (0, 1), ''.join(launch.said)


def end_at(launch, step, deafen):
    """Make a launch's output fail in a step, and end the launch."""
    launch.wait_for(STEPS['running' if step == 'ending' else step])
    if step == 'ending':
        launch.child.send_signal(signal.SIGINT)
        launch.wait_for('SIGINT')
    deafen()
    if step != 'ending' and launch.child.poll() is None:
        launch.child.send_signal(signal.SIGINT)
    assert launch.ended() in (0, 1)
    assert containers() == [] and not Store().exists(NAME)


# test_runtime_console.py has all kinds of screens
@pytest.mark.parametrize(('step', 'output'), [('ending', 'terminal'), ('running', 'unread pipe')])
def test_closed_output_takes_everything_back(launched, request, step, output):
    """A closed terminal also sends SIGHUP; `| less` does not read until it is asked to."""
    if output == 'terminal':
        request.getfixturevalue('root_at_login')
    launch = launched(terminal=output == 'terminal')
    end_at(launch, step, lambda: launch.deafen(close=output != 'unread pipe'))


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
        end_at(launch, 'running', lambda: fill(disk))
        assert 'Logging error' not in ''.join(launch.said)
    finally:
        process.run(Command(('umount', '-l', str(disk)), sudo=True), timeout=60.0)


def fill(disk: Path) -> None:
    """Leave no byte of a disk."""
    with open(disk / 'all', 'wb', buffering=0) as file:
        for size in (4096, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(b'x' * size)


# without a machine, with an agent that had heartbeats; benchmarks/chaos.py kills at any time
@pytest.mark.parametrize('step', ['create', 'running'])
def test_a_killed_launch_leaves_a_machine_that_ends_itself(launched, step):
    launch = launched(timeout=6)
    launch.wait_for(STEPS[step])
    launch.child.kill()
    launch.ended()
    # orphaned robot nodes are the user's to end, as with any launch that was killed
    end_group(launch.child.pid)
    # before, it has minutes to be found by its launch
    if step == 'running':
        wait_until(lambda: not containers(), timeout=60,
                   what='the machine to end itself')
    # killed early, it may have had no machine yet; an engine may still be making one
    wait_until(lambda: fog('delete', NAME, '--yes') is not None and not containers(),
               timeout=60, what='ros2 fog delete')
    assert fog('gc') == 0


def end_group(group: int) -> None:
    try:
        os.killpg(group, signal.SIGKILL)
    except ProcessLookupError:
        pass


def containers() -> list[str]:
    # root's, and as a user without sudo the engine would leave a process of its own behind
    return process.run(
        Command(('podman', 'ps', '-aq', '--filter', f'name=fogros2-{NAME}'), sudo=True),
        timeout=30.0).stdout.split()


def fog(*words: str) -> int:
    return subprocess.run(['ros2', 'fog', *words], capture_output=True, timeout=60).returncode


def test_nodes_respawn_when_their_agent_is_killed(launched):
    launch = launched()
    launch.wait_for(STEPS['running'])
    launch.said.clear()
    killed = subprocess.run(
        ['ros2', 'fog', 'connect', NAME, '--', 'sh', '-c',
         'sudo kill -9 $(cat /run/fogros2/agent.pid)'],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60)
    assert killed.returncode == 0, killed
    launch.wait_for('its agent died and was started again')
    launch.wait_for('process started with pid')
    launch.wait_for('Publishing')
    end_twice(launch, signal.SIGTERM)
