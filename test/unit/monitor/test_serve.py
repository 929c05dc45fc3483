# SPDX-License-Identifier: Apache-2.0
"""The start of a bridge on a machine; ``security/test_websites.py`` has what it leads to."""

from __future__ import annotations

import os
from pathlib import Path
import socket
import subprocess
import sys

from ament_index_python.packages import get_package_prefix
import pytest

from fogros2.waiting import wait_until
from rigs.domains import taken

serve = pytest.importorskip(
    'fogros2_monitor.serve', reason='rclpy is not installed')
BRIDGE = [sys.executable, str(Path(get_package_prefix('fogros2'), 'lib/fogros2/bridge'))]


@pytest.fixture(autouse=True)
def imported(tmp_path, monkeypatch):
    """Start all in a folder with modules of another account, which nothing imports."""
    for name in ('argparse', 'asyncio', 'foxglove'):
        (tmp_path / f'{name}.py').write_text(f'open({str(tmp_path / "imported")!r}, "w").close()')
    monkeypatch.chdir(tmp_path)
    yield
    assert not (tmp_path / 'imported').exists()


def test_unwritable_token_folder_is_named(tmp_path, monkeypatch):
    (tmp_path / 'file').touch()
    monkeypatch.setattr(sys, 'argv', ['bridge', '--secrets', f'{tmp_path}/file/secrets'])
    with pytest.raises(SystemExit, match='its token to .*\n--secrets names another folder'):
        serve.main()


@pytest.mark.skipif(os.geteuid() != 0, reason='sudo looks for podman in folders of its own')
def test_application_starts_only_once_the_gate_listens(tmp_path):
    """Else the bridge of another launch, at whose port this one fails, would lose its own."""
    podman = tmp_path / 'podman'
    podman.write_text(f'#!/bin/sh\necho >>{tmp_path}/called\nexit 1\n')
    podman.chmod(0o755)
    with socket.create_server(('127.0.0.1', 0)) as other, taken() as domain:
        port = other.getsockname()[1]
        words = [*BRIDGE, '--image', 'x', '--secrets', str(tmp_path),
                 '--listen', f'127.0.0.1:{port}', '--vpn', str(port)]
        options = {'stderr': subprocess.DEVNULL, 'stdout': subprocess.DEVNULL, 'env': {
            **os.environ, 'ROS_DOMAIN_ID': domain, 'FOGROS2_VPN_ADDRESS': '127.0.0.2',
            'PATH': f'{tmp_path}:{os.environ["PATH"]}'}}
        subprocess.run(words, timeout=60, **options)
        assert not (tmp_path / 'called').exists()
        other.close()
        with subprocess.Popen(words, **options) as bridge:
            try:
                wait_until((tmp_path / 'called').exists, timeout=60, what='the application')
            finally:
                bridge.terminate()


def test_taken_port_is_named_and_ends_the_bridge(tmp_path):
    """So it starts again, when the port may be free."""
    pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')
    with socket.create_server(('127.0.0.1', 0)) as other, taken() as domain:
        port = other.getsockname()[1]
        done = subprocess.run(
            [*BRIDGE, '--listen', f'127.0.0.1:{port}', '--secrets', str(tmp_path)],
            capture_output=True, text=True, timeout=60, env={
                **os.environ, 'ROS_DOMAIN_ID': domain,
                'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'})
    assert done.returncode == 1
    assert f'nobody can listen at 127.0.0.1:{port}: Address already in use\n' in done.stderr
    assert 'the gate has ended' in done.stderr and 'Traceback' not in done.stderr
