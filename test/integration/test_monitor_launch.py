# SPDX-License-Identifier: Apache-2.0
"""A bridge on a container machine: by the VPN, by a tunnel, and by nothing else."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import html
import json
from pathlib import Path
import re
import secrets
import signal
import socket
import ssl
import subprocess
import urllib.request

import pytest

pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')

from fogros2.model import Command
from fogros2.process import run
from fogros2.store import Store
from fogros2.waiting import wait_until
from rigs import viewer as viewers
from rigs.launched import launching, ros2

ROOT = Path(__file__).parents[2]
CACHE = ROOT / '.cache/node'
LAUNCH_FILE = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription


def generate_launch_description():
    machine = ContainerInstance(name={name!r}, launch_foxglove=True{more})
    return FogROSLaunchDescription([CloudNode(
        machine=machine, package='fogros2_examples', executable='talker', name='talker')])
"""
ON_ROBOT = """
from fogros2 import CloudNode, ContainerInstance, Foxglove, FogROSLaunchDescription


def generate_launch_description():
    machine = ContainerInstance(name='planner')
    return FogROSLaunchDescription([Foxglove(machine), CloudNode(
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
        wait_until(lambda: parameters(viewer) == [{'name': '/talker.use_sim_time',
                                                   'value': False}],
                   timeout=60.0, what='a parameter')
    finally:
        viewer.close()


def parameters(viewer: viewers.Viewer) -> list[dict[str, object]]:
    viewer.wish(get=['/talker.use_sim_time'])
    return viewer.until('id', 'get')['parameters']


@contextlib.contextmanager
def tunnel(name: str) -> Iterator[str]:
    """Yield a bridge's address, with its token, as the command line has it."""
    process = subprocess.Popen(
        ['ros2', 'fog', 'monitor', name, '--no-browser'], stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, stdin=subprocess.DEVNULL)
    try:
        url = re.search(r'is at (ws://127.0.0.1:\d+/\?token=\S+) ', process.stdout.readline())[1]
        page = process.stdout.readline().strip()
        assert page.startswith('http://127.0.0.1:') and page.endswith(url.partition('?')[2])
        # the machine runs no containers, and so has no application
        with urllib.request.urlopen(page, timeout=60) as answer:
            assert html.escape(url) in answer.read().decode()
        yield url
    finally:
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=30)[0] == '\n'
    assert process.returncode == 0


def knock(at: tuple[str, int], target: str, *, tls: bool = True) -> bytes:
    """Return what answers a request, nothing where the connection just ends."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with contextlib.suppress(ConnectionResetError, ssl.SSLEOFError, ssl.SSLZeroReturnError), \
            socket.create_connection(at, timeout=60) as plain, \
            context.wrap_socket(plain) if tls else contextlib.nullcontext(plain) as connection:
        connection.sendall(f'GET {target} HTTP/1.1\r\nHost: {at[0]}\r\n\r\n'.encode())
        return connection.recv(4096)
    return b''


def test_monitor_works_for_a_machine_on_the_robot(nothing_left, tmp_path, state_home):
    file = tmp_path / 'monitor.launch.py'
    file.write_text(ON_ROBOT)
    with launching() as launch:
        launched = launch(str(file), '--machine', 'planner=robot')
        launched.wait_for('planner: Foxglove at ws://127.0.0.1:8765; in a browser: '
                          'ros2 fog monitor planner')
        launched.wait_for('serving ws://')
        told = ros2('fog', 'monitor', 'planner', '--no-browser').stdout
        url = re.match(r'planner is at (ws://127.0.0.1:8765/\?token=(\S+)); in a browser:\n', told)
        sees_the_talker(url[1])
        assert knock(('localhost', 8765), '/', tls=False).startswith(b'HTTP/1.1 401 ')
        launched.interrupt()
        assert launched.ended() == 0, launched.text
        assert url[2] not in launched.text
    assert not list(state_home.rglob('token'))


def test_viewers_need_the_token(nothing_left, engine, cloud_network, tmp_path):
    name = f'mon-{secrets.token_hex(2)}'
    gateway = json.loads(run(Command(
        ('podman', 'network', 'inspect', cloud_network), sudo=True), timeout=60).stdout)[0][
            'subnets'][0]['gateway']
    file = tmp_path / 'monitor.launch.py'
    file.write_text(LAUNCH_FILE.format(
        name=name, more=f', network={cloud_network!r}, monitor_allow=[{gateway!r}]'))
    with launching() as launch:
        launched = launch(str(file))
        launched.wait_for('serving ws://')
        launched.wait_for('the certificate has the SHA-256')
        told = re.search(
            r'Foxglove for (\S+) at wss://(\S+):(\d+); with its token: (.*)', launched.text)
        assert (told[1], told[4]) == (f'{gateway}/32', f'ros2 fog monitor {name} --share')
        at = told[2], int(told[3])
        assert at == (Store().load(name).endpoint.host, 8766)

        shared = ros2('fog', 'monitor', name, '--share').stdout.splitlines()
        url = shared[0]
        assert url.startswith(f'wss://{at[0]}:{at[1]}/?token=')
        fingerprint = re.search('SHA-256 is (.*)', '\n'.join(shared))[1]
        assert f'the certificate has the SHA-256 {fingerprint}' in launched.text
        target = url.partition(str(at[1]))[2]
        token = target.partition('=')[2]
        assert token not in launched.text

        sees_the_talker(url)
        assert b'certificate is accepted' in knock(at, target)
        inside = re.search(r'Foxglove at (ws://\S+?); in a browser', launched.text)
        vpn = tuple(inside[1].removeprefix('ws://').split(':'))
        sees_the_talker(f'{inside[1]}/?token={token}')
        assert knock(vpn, '/', tls=False).startswith(b'HTTP/1.1 401 ')
        assert (f'{name}: topics at {inside[1]}; with its token: ros2 fog monitor {name}'
                in ros2('fog', 'list').stdout)
        status = ros2('fog', 'status', name).stdout
        assert f'monitor open  {at[0]}:{at[1]}' in status and inside[1][len('ws'):] in status
        with tunnel(name) as near:
            assert near.endswith(f'/?token={token}')
            sees_the_talker(near)
            port = int(re.search(r':(\d+)/', near)[1])
            assert knock(('localhost', port), '/', tls=False).startswith(b'HTTP/1.1 401 ')
        assert knock(at, '/').startswith(b'HTTP/1.1 401 ')
        robot = re.search(r'VPN interface .*\(\S+ (\S+)\)', launched.text)[1]
        for who in (robot, '127.0.0.1', gateway):
            launched.wait_for(f'turned away {who}: no token')
        # where the machine is reached without the VPN, nobody listens without asking
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((at[0], 8765), timeout=20)
        launched.interrupt()
        assert launched.ended() == 0
        assert launched.errors == []
