# SPDX-License-Identifier: Apache-2.0
"""A machine that nobody uses ends while its launch goes on, and one in use does not."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import uuid

import pytest

from fogros2.waiting import wait_until
from rigs.launched import launching, ros2

pytestmark = [pytest.mark.usefixtures('nothing_left', 'engine')]

WORK = 'import time\\nwhile True:\\n    sum(range(3 * 10 ** 6)); time.sleep(0.2)'
LAUNCH = """
from fogros2 import CloudGroup, CloudNode, ContainerInstance, FogROSLaunchDescription
from launch.actions import ExecuteProcess
from launch_ros.actions import Node


def generate_launch_description():
    common = {{'network': '{network}', 'ros_workspace': '', 'idle_timeout': '5s'}}
    waits = ContainerInstance(name='{name}-waits', on_exit='{on_exit}', **common)
    works = ContainerInstance(name='{name}-works', **common)
    return FogROSLaunchDescription([
        CloudNode(machine=waits, package='fogros2_examples', executable='listener',
                  respawn=True, remappings=[('chatter', '/nobody')]),
        CloudGroup(machine=works, actions=[
            ExecuteProcess(cmd=['python3', '-c', {work!r}])]),
        Node(package='fogros2_examples', executable='talker', output='screen'),
    ])
"""


def test_machine_without_use_ends_as_on_exit_says(tmp_path: Path, cloud_network: str) -> None:
    """The next test has the default."""
    name = f'idle-{uuid.uuid4().hex[:6]}'
    path = tmp_path / 'idle.launch.py'
    path.write_text(LAUNCH.format(name=name, network=cloud_network, on_exit='keep',
                                  work=WORK.replace('\\n', '\n')))
    with launching() as start:
        run = start(str(path))
        run.wait_for(f'{name}-waits: the machine has ended')
        assert f"{name}-waits: nobody has used it for 5 s; on_exit='keep'" in run.text
        listed = ros2('fog', 'list').stdout
        assert f'{name}-waits' in listed and f'{name}-works' in listed
        run.said.clear()
        run.wait_for('Publishing', times=3)
        assert f'{name}-works: nobody' not in run.text and run.errors == [], run.text
        run.interrupt()
        assert run.ended() == 0, run.text
    assert ros2('fog', 'delete', f'{name}-waits', '--yes').returncode == 0


def test_machine_with_an_open_terminal_is_not_idle(tmp_path: Path, cloud_network: str) -> None:
    name = f'idle-{uuid.uuid4().hex[:6]}'
    path = tmp_path / 'idle.launch.py'
    path.write_text(LAUNCH.format(name=name, network=cloud_network, on_exit='delete',
                                  work=WORK.replace('\\n', '\n')))
    with launching() as start:
        run = start(str(path))
        run.wait_for('process started with pid', times=3)
        ours, theirs = os.openpty()
        terminal = subprocess.Popen(['ros2', 'fog', 'connect', f'{name}-waits'], stdin=theirs,
                                    stdout=theirs, stderr=theirs, start_new_session=True)
        try:
            os.write(ours, b'echo here $((6 * 7))\n')
            said = b''
            while b'here 42' not in said:
                said += os.read(ours, 4096)
            # in use, it is still there after twice the time; the talker speaks once a second
            run.said.clear()
            run.wait_for('Publishing', times=12)
            assert 'nobody has used' not in run.text, run.text
        finally:
            os.write(ours, b'exit\n')
            terminal.wait(30)
            os.close(ours)
            os.close(theirs)
        run.wait_for(f'{name}-waits: the machine has ended')
        assert f'{name}-waits' not in ros2('fog', 'list').stdout
        run.interrupt()
        assert run.ended() == 0, run.text
    wait_until(lambda: name not in ros2('fog', 'list').stdout, timeout=60, what='the end')
