# SPDX-License-Identifier: Apache-2.0
"""A second robot joins the machine of a launch by an invitation, and leaves it."""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import uuid

import pytest

from fogros2.model import Command
from fogros2.process import run
from fogros2.waiting import wait_until
from rigs.launched import Launched, launching, ros2
from rigs.second_robot import second, SecondRobot

__all__ = ['second']

NAME = f'shared-{uuid.uuid4().hex[:6]}'
LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}', ros_workspace='')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen', remappings=[('chatter', '/far')]),
        CloudNode(machine=machine, package='fogros2_examples', executable='listener',
                  output='screen', remappings=[('chatter', '/near')])])
"""


@pytest.fixture
def launch(
    tmp_path: Path, cloud_network: str, engine: str, nothing_left: None,
) -> Iterator[Launched]:
    path = tmp_path / 'shared.launch.py'
    path.write_text(LAUNCH.format(name=NAME, network=cloud_network))
    with launching() as start:
        started = start(str(path))
        started.wait_for('Publishing')
        # this computer forwards nothing from a network of the tests: let answers out
        said = run(Command((engine, 'network', 'inspect', cloud_network), sudo=True), timeout=30.0)
        bridge = json.loads(said.stdout)[0]['network_interface']
        run(Command.script(f'echo 1 >/proc/sys/net/ipv4/conf/{bridge}/forwarding', sudo=True),
            timeout=60.0)
        yield started
        started.interrupt()
        assert started.ended() == 0, started.text


def fog(*words: str, status: int = 0) -> str:
    done = ros2('fog', *words)
    assert done.returncode == status, done.stdout + done.stderr
    return str(done.stderr if status else done.stdout).strip()


def invited(second: SecondRobot, *options: str) -> str:
    key = second.run('ros2', 'fog', 'key').strip()
    return fog('invite', NAME, '--key', key, '--address', second.host, *options)


def test_second_robot_behind_nat_hears_and_is_heard(launch: Launched, second: SecondRobot) -> None:
    old = invited(second, '--for', '1s')
    wait_until(lambda: 'GUEST' not in fog('status', NAME), timeout=60, what='the expiry')
    assert 'has expired' in second.run('ros2', 'fog', 'join', old, status=1)
    text = invited(second)
    own = ('198.18.0.9/15', 'dev', 'lo')
    second.ip('-n', second.spaces[1], 'address', 'add', *own)
    said = second.run('ros2', 'fog', 'join', text, status=1)
    assert 'this computer uses 198.18.0.0/15' in said and 'FOGROS2_VPN_POOL' in said
    second.ip('-n', second.spaces[1], 'address', 'delete', *own)
    second.run('sh', '-ec', f'eval "$(ros2 fog join {text})"; ros2 topic echo --once '
               '/far std_msgs/msg/String')
    speaker = second.start('sh', '-ec', f'eval "$(ros2 fog env {NAME})"; exec ros2 topic pub '
                           "/near std_msgs/msg/String '{data: from the second}'")
    try:
        launch.wait_for('from the second')
    finally:
        speaker.terminate()
        speaker.communicate()
    assert 'GUEST' in fog('status', NAME)
    assert 'round trip' in second.run('ros2', 'fog', 'status', NAME)
    second.run('ros2', 'fog', 'join', text)  # once more changes nothing
    assert second.run('ros2', 'fog', 'leave', NAME) == f'left {NAME}\n'
    assert 'has not joined' in second.run('ros2', 'fog', 'leave', NAME, status=1)
    assert 'no guest robot9' in fog('revoke', NAME, 'robot9', status=1)
    assert fog('revoke', NAME).startswith('revoked ')
    wait_until(lambda: 'GUEST' not in fog('status', NAME), timeout=60, what='the guest to be gone')
