# SPDX-License-Identifier: Apache-2.0
"""Which bridge runs on a machine, and with which options."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import socket
import subprocess
import sys

import pytest

serve = pytest.importorskip(
    'fogros2_monitor.serve', reason='rclpy is not installed')


def test_patterns_become_regular_expressions():
    assert serve.regular_expression('/camera/*') == '/camera/.*'
    assert serve.regular_expression('/a.b?[c]') == r'/a\.b.\[c\]'
    assert serve.command('127.9.9.9', 5, '/x', ['/a*'], ['-r', 'b:=c'])[1:] == [
        '--ros-args', '-r', 'b:=c', '-p', 'address:=127.9.9.9', '-p', 'port:=5',
        *(word for name in ('topic', 'service', 'param') for word in (
            '-p', f'{name}_whitelist:=["/a.*"]'))]
    assert serve.command('127.9.9.9', 5, '', ['/a*'], [])[1:3] == ['-m', 'fogros2_monitor.bridge']


def test_foxglove_bridge_of_ros_runs_if_installed(tmp_path):
    """It is on the loopback, the gate stands before it, and both end together."""
    index = tmp_path / 'share/ament_index/resource_index/packages'
    index.mkdir(parents=True)
    (index / 'foxglove_bridge').write_text('')
    program = tmp_path / 'lib/foxglove_bridge/foxglove_bridge'
    program.parent.mkdir(parents=True)
    program.write_text('#!/bin/sh\necho "theirs $*"\nexec sleep 60\n')
    program.chmod(0o755)
    with socket.create_server(('127.0.0.1', 0)) as probe:
        port = probe.getsockname()[1]
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '')
    process = subprocess.Popen(
        [sys.executable, '-m', 'fogros2_monitor.serve', '--listen', f'127.0.0.1:{port}',
         '--secrets', str(tmp_path / 'secrets'), '--topic', '/camera/*'],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=Path(__file__).parents[3],
        env={**os.environ, 'AMENT_PREFIX_PATH': f'{tmp_path}{os.pathsep}{prefixes}'})
    try:
        lines = sorted(process.stdout.readline().strip() for _ in range(2))
        assert lines[0] == f'listening on 127.0.0.1:{port}'
        assert lines[1].startswith('theirs --ros-args -p address:=127.')
        assert lines[1].endswith('-p param_whitelist:=["/camera/.*"]')
    finally:
        process.send_signal(signal.SIGTERM)
        # the gate has our pipe too: its end is what this waits for
        assert process.communicate(timeout=20)[0] == ''


def test_unwritable_token_folder_is_named(tmp_path, monkeypatch):
    (tmp_path / 'file').touch()
    monkeypatch.setattr(sys, 'argv', ['bridge', '--secrets', f'{tmp_path}/file/secrets'])
    with pytest.raises(SystemExit, match='its token to .*\n--secrets names another folder'):
        serve.main()
