# SPDX-License-Identifier: Apache-2.0
"""A bridge on a container machine: by the VPN, by a tunnel, and by nothing else."""

from __future__ import annotations

from pathlib import Path
import re
import secrets
import signal
import socket
import subprocess

import pytest

pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')

from fogros2.store import Store
from fogros2.testing import viewer as viewers
from fogros2.testing.launched import launching

pytestmark = pytest.mark.timeout(120)
ROOT = Path(__file__).parents[2]
CACHE = ROOT / '.cache/node'
LAUNCH_FILE = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    machine = ContainerInstance(name={name!r}, launch_foxglove=True)
    return FogROSLaunchDescription([CloudNode(
        machine=machine, package='fogros2_examples', executable='talker', name='talker')])
"""


@pytest.fixture(scope='module', autouse=True)
def client() -> None:
    why_not = viewers.install(ROOT / 'test/node', CACHE)
    if why_not:
        pytest.skip(why_not)


def sees_the_talker(url: str) -> None:
    viewer = viewers.Viewer(CACHE, url)
    try:
        viewer.look('/chatter')
        assert viewer.message('/chatter')['data'].startswith('Hello World')
    finally:
        viewer.close()


def test_a_viewer_comes_in_by_the_vpn_and_by_a_tunnel(nothing_left, engine, tmp_path):
    name = f'mon-{secrets.token_hex(2)}'
    file = tmp_path / 'monitor.launch.py'
    file.write_text(LAUNCH_FILE.format(name=name))
    with launching() as launch:
        launched = launch(str(file))
        launched.wait_for('serving ws://')
        url = re.search(r'Foxglove at (ws://\S+?);', launched.text)[1]
        assert f'in a browser: ros2 fog monitor {name}' in launched.text
        sees_the_talker(url)

        # where the robot reaches the machine without the VPN, nobody listens
        outside = Store().machine(name).load().shell.host
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((outside, 8765), timeout=20)

        tunnel = subprocess.Popen(
            ['ros2', 'fog', 'monitor', name, '--no-browser'], stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, stdin=subprocess.DEVNULL)
        try:
            near = re.search(r'is at (ws://localhost:\d+) ', tunnel.stdout.readline())[1]
            assert tunnel.stdout.readline().startswith(
                'https://app.foxglove.dev/~/view?ds=foxglove-websocket&ds.url=ws%3A%2F%2F')
            sees_the_talker(near)
        finally:
            tunnel.send_signal(signal.SIGINT)
            assert tunnel.communicate(timeout=30)[0] == '\n'
        assert tunnel.returncode == 0
        launched.interrupt()
        assert launched.ended() == 0
        assert launched.errors == []
