# SPDX-License-Identifier: Apache-2.0
"""A machine that nobody uses ends while its launch goes on, and one in use does not."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import uuid

import pytest

from rigs.launched import launching, ros2

pytestmark = [pytest.mark.usefixtures('nothing_left', 'engine')]

LAUNCH = """
from fogros2 import CloudGroup, CloudNode, ContainerInstance, FogROSLaunchDescription
from launch.actions import ExecuteProcess
from launch_ros.actions import Node


def generate_launch_description():
    common = {{'network': '{network}', 'ros_workspace': '', 'idle_timeout': '5s'}}
    waits = [ContainerInstance(name='{name}-kept', on_exit='keep', **common),
             ContainerInstance(name='{name}-seen', **common)]
    works = ContainerInstance(name='{name}-works', **common)
    work = 'import time\\nwhile True:\\n    sum(range(10 ** 6)); time.sleep(0.2)'
    return FogROSLaunchDescription([
        *[CloudNode(machine=machine, package='fogros2_examples', executable='listener',
                    respawn=True, remappings=[('chatter', '/nobody')]) for machine in waits],
        CloudGroup(machine=works, actions=[ExecuteProcess(cmd=['python3', '-c', work])]),
        Node(package='fogros2_examples', executable='talker', output='screen'),
    ])
"""


def test_machine_without_use_ends_as_on_exit_says(tmp_path: Path, cloud_network: str) -> None:
    """One waits, another has an open terminal meanwhile, and the third computes."""
    name = f'idle-{uuid.uuid4().hex[:6]}'
    path = tmp_path / 'idle.launch.py'
    path.write_text(LAUNCH.format(name=name, network=cloud_network))
    with launching() as start:
        run = start(str(path))
        run.wait_for('process started with pid', times=4)
        ours, theirs = os.openpty()
        terminal = subprocess.Popen(['ros2', 'fog', 'connect', f'{name}-seen'], stdin=theirs,
                                    stdout=theirs, stderr=theirs, start_new_session=True)
        try:
            os.write(ours, b'echo here $((6 * 7))\n')
            said = b''
            while b'here 42' not in said:
                said += os.read(ours, 4096)
            run.wait_for(f'{name}-kept: the machine has ended')
            assert f"{name}-kept: nobody has used it for 5 s; on_exit='keep'" in run.text
            assert all(f'{name}-{which}' in ros2('fog', 'list').stdout
                       for which in ('kept', 'seen', 'works'))
            # the others are still there after twice the time; the talker speaks once a second
            run.said.clear()
            run.wait_for('Publishing', times=12)
            assert 'nobody has used' not in run.text and run.errors == [], run.text
        finally:
            os.write(ours, b'exit\n')
            terminal.wait(30)
            os.close(ours)
            os.close(theirs)
        run.wait_for(f'{name}-seen: the machine has ended')
        assert f'{name}-seen' not in ros2('fog', 'list').stdout
        assert f'{name}-works: nobody' not in run.text
        run.interrupt()
        assert run.ended() == 0, run.text
    assert ros2('fog', 'delete', f'{name}-kept', '--yes').returncode == 0
    assert name not in ros2('fog', 'list').stdout
