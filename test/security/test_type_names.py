# SPDX-License-Identifier: Apache-2.0
"""A node of another computer chooses the type names of its topics; they import nothing else."""

from __future__ import annotations

import os
from pathlib import Path
import re
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
from fogros2 import ros_types
from fogros2_monitor import GRAPH

ROOT = Path(__file__).resolve().parents[2]
#: Writes a file when it is imported.
TRAP = 'open({!r}, "w").close()\n'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make the current folder one with modules of another account, which Python finds first."""
    trap = TRAP.format(str(tmp_path / 'imported'))
    (tmp_path / 'drive.py').write_text(trap)
    for name in ('rover', 'std_srvs', 'rclpy', 'json'):
        (tmp_path / name / 'msg').mkdir(parents=True)
        (tmp_path / name / '__init__.py').write_text(trap)
        (tmp_path / name / 'msg' / '__init__.py').write_text('class X: ...\n')
    monkeypatch.chdir(tmp_path)
    return tmp_path


NAMES = [
    'drive/msg/X', 'rover/msg/X', 'rover/X', 'antigravity/msg/X', 'this/srv/X', 'venv/__main__/X',
    'fogros2/agent/Agent', 'std_srvs/srv/Trigger', 'std_srvs/msg/X', 'launch/msg/X',
    'std_msgs.msg/msg/String', 'std_msgs/msg/String/x', 'std_msgs//String', '../msg/X',
    'std_msgs/msg/\x1b[2J', '']


def test_type_names_import_interfaces_only(folder: Path) -> None:
    """The current folder comes first on the path, as with ``python -m`` or an empty PYTHONPATH."""
    code = ('import sys; from fogros2 import ros_types; before = {*sys.modules}\n'
            'sys.path.insert(0, "")\n'
            'for load in (ros_types.message, ros_types.service):\n'
            '    for name in sys.argv[1:]:\n'
            '        try:\n            load(name)\n'
            '        except LookupError as error:\n            assert str(error).isprintable()\n'
            '        else:\n            print("imported", name)\n'
            'print(*{name.partition(".")[0] for name in {*sys.modules} - before})\n')
    done = subprocess.run(
        [sys.executable, '-c', 'import sys; sys.path.remove("")\n' + code, *NAMES],
        capture_output=True, text=True, timeout=30)
    assert done.returncode == 0, done.stderr
    assert not {*done.stdout.split()} & {
        'imported', 'drive', 'rover', 'antigravity', 'venv', 'this'}
    assert not (folder / 'imported').exists()


def test_interfaces_are_imported_by_their_names() -> None:
    from std_msgs.msg import String
    from std_srvs.srv import Trigger
    assert ros_types.message('std_msgs/msg/String') is String
    assert ros_types.message('std_msgs/String') is String
    assert ros_types.service('std_srvs/srv/Trigger') is Trigger
    for load, name in ((ros_types.message, 'std_srvs/srv/Trigger'),
                       (ros_types.service, 'std_msgs/msg/String')):
        with pytest.raises(LookupError, match=name):
            load(name)


def test_only_the_checked_import_takes_names_of_types() -> None:
    """Functions of rosidl_runtime_py import every module that a name has."""
    for package in ('fogros2', 'fogros2_monitor', 'fogros2_replicas', 'fogros2_share',
                    'image_transport_h264', 'point_cloud_stream', 'ros2fog_cli'):
        for path in (ROOT / package).rglob('*.py'):
            text = path.read_text()
            assert 'rosidl_runtime_py' not in text, path
            if package in ('fogros2_monitor', 'fogros2_replicas', 'fogros2_share'):
                assert not re.search(r'\bimport_module\(', text), path


def test_graph_program_imports_nothing_of_current_folder(folder: Path) -> None:
    """The robot's launch and the dashboard start it where the user is, such as in /tmp."""
    done = subprocess.run(GRAPH, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True,
                          env={**os.environ, 'PYTHONPATH': ''}, text=True, timeout=60)
    assert not (folder / 'imported').exists()
    assert done.returncode == 0, done.stderr
