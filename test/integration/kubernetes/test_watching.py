# SPDX-License-Identifier: Apache-2.0
"""Others than the robot watch a pod, by a Service that keeps their addresses."""

from __future__ import annotations

import contextlib
import re
import shutil
import socket
import ssl

import pytest

from fogros2 import kubernetes_client
from fogros2.provider.kubernetes import exposure
from fogros2.waiting import wait_until
from rigs.cluster import READY
from rigs.launched import launching, ros2

pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')
pytestmark = [
    # the parts are tried in a shorter time: the Service by the contract, the gate elsewhere
    pytest.mark.soak,
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH')]
LAUNCH_FILE = """
from fogros2 import CloudNode, FogROSLaunchDescription, KubeInstance


def generate_launch_description():
    machine = KubeInstance(name='watched', container_image={image!r}, ros_workspace='',
                           expose='node_port', monitor_allow={allow!r})
    return FogROSLaunchDescription([CloudNode(
        machine=machine, package='fogros2_examples', executable='talker', name='talker')])
"""


def status(at: tuple[str, int], target: str) -> str:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with contextlib.suppress(OSError), socket.create_connection(at, timeout=5) as plain, \
            context.wrap_socket(plain) as link:
        link.sendall(f'GET {target} HTTP/1.1\r\nHost: x\r\n\r\n'.encode())
        return link.recv(4096).split()[1].decode()
    return ''


def test_who_is_allowed_gets_in_by_the_node_s_port(
        kubernetes, namespace, tmp_path, monkeypatch):
    if reason := kubernetes.why_not_ready:
        pytest.skip(reason)
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    own = exposure.own_address(kubernetes_client.connect('').server)
    file = tmp_path / 'watched.launch.py'
    file.write_text(LAUNCH_FILE.format(
        image=READY, allow=[own]))
    with launching() as start:
        run = start(str(file))
        run.wait_for('the certificate has the SHA-256', timeout=150)
        run.wait_for('with its token: ')
        found = re.search(r' at wss://(\S+):(\d+); with its token', run.text)
        at = found[1], int(found[2])
        url = ros2('fog', 'monitor', 'watched', '--share').stdout.splitlines()[0]
        target = url.partition(f'{at[1]}')[2]
        wait_until(lambda: status(at, '/') == '401' or None, timeout=30, what='the gate')
        assert status(at, target) == '200'
        assert any('watched-8766' in line for line in namespace.left())
        run.interrupt()
        assert run.ended() == 0, run.text
    wait_until(lambda: not any('watched' in line for line in namespace.left()) or None,
               timeout=30, what='the Services to go with the Job')
