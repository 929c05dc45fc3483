# SPDX-License-Identifier: Apache-2.0
"""Terminals that join a launch, and the daemon that ROS 2's commands ask."""

from __future__ import annotations

from pathlib import Path
import subprocess
import uuid

import pytest

from fogros2.waiting import wait_until
from rigs.launched import launching, ros2

pytest.importorskip('ros2cli.daemon', reason='the embedded default has no daemon')
pytestmark = pytest.mark.usefixtures('nothing_left', 'engine')

#: Other runs of this test may be under way on the same computer.
NAME = f'terminal-{uuid.uuid4().hex[:6]}'
#: A topic that nothing on the robot publishes or reads.
LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    machine = ContainerInstance(name='{name}', network='{network}', ros_workspace='')
    return FogROSLaunchDescription([CloudNode(
        machine=machine, package='fogros2_examples', executable='talker', output='screen',
        remappings=[('chatter', '/far')])])
"""
#: The first of these starts a daemon, the others ask it.
LOOK = 'for n in 1 2 3 4 5; do ros2 topic list >seen; done; cat seen; ros2 topic info /far'


def daemons(domain: str) -> set[str]:
    """Return the ids of a domain's daemons."""
    found = set()
    for path in Path('/proc').glob('[0-9]*/cmdline'):
        try:
            words = path.read_bytes().split(b'\0')
        except OSError:
            continue
        if b'ros2-daemon' in words and domain.encode() in words:
            found.add(path.parent.name)
    return found


def test_terminals_see_the_machine_and_leave_no_daemon(
    tmp_path: Path, cloud_network: str, domain: str,
) -> None:
    path = tmp_path / 'far.launch.py'
    path.write_text(LAUNCH.format(name=NAME, network=cloud_network))

    def terminal(*words: str) -> str:
        done = subprocess.run(words, cwd=tmp_path, capture_output=True,
                              text=True, timeout=120, stdin=subprocess.DEVNULL)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert ros2('daemon', 'start').returncode == 0
    before = daemons(domain)
    assert len(before) == 1
    try:
        with launching() as launch:
            run = launch(str(path))
            run.wait_for('Publishing')
            seen = terminal('ros2', 'fog', 'shell', NAME, '--', 'sh', '-ec', LOOK)
            assert '/far' in seen.splitlines() and 'Publisher count: 1' in seen, seen
            # one daemon for all terminals of the launch
            assert len(daemons(domain)) == 2
            seen = terminal('sh', '-ec', f'eval "$(ros2 fog env {NAME})"; {LOOK}')
            assert '/far' in seen.splitlines() and 'Publisher count: 1' in seen, seen
            assert len(daemons(domain)) == 2
            run.interrupt()
            assert run.ended() == 0, run.text
        wait_until(lambda: daemons(domain) == before, timeout=60, what='the daemon to end')
        # other terminals have not noticed anything
        assert '/rosout' in terminal('ros2', 'topic', 'list')
    finally:
        terminal('ros2', 'daemon', 'stop')
