# SPDX-License-Identifier: Apache-2.0
"""Tests that hold for ROS 2 and for the embedded default alike."""

from collections.abc import Callable, Iterator
import contextlib
import json
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

import pytest

from rigs.domains import taken


@pytest.fixture(autouse=True, scope='module')
def ros_of_this_computer() -> Iterator[None]:
    """
    Let nodes see no others.

    They use no shared memory either: Fast DDS writes errors to stdout where a process of another
    network namespace has the same port in /dev/shm.
    """
    with pytest.MonkeyPatch.context() as patch, taken() as domain:
        patch.setenv('ROS_DOMAIN_ID', domain)
        patch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE',
                     str(Path(__file__).with_name('loopback.xml')))
        for name in ('RMW_IMPLEMENTATION', 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_STATIC_PEERS',
                     'ROS_LOCALHOST_ONLY'):
            patch.delenv(name, raising=False)
        patch.setenv('RCUTILS_COLORIZED_OUTPUT', '0')
        yield


@pytest.fixture
def own_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let launch log into the test's folder, and leave its parameter files there."""
    import launch.logging
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    launch.logging.reset()
    yield
    launch.logging.reset()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Install a package 'pkg' with an executable 'exe' that prints its arguments."""
    root = tmp_path / 'prefix'
    index = root / 'share/ament_index/resource_index/packages'
    for folder in (index, root / 'share/pkg', root / 'lib/pkg'):
        folder.mkdir(parents=True)
    (index / 'pkg').touch()
    executable = root / 'lib/pkg/exe'
    executable.write_text('#!/bin/sh\nfor word; do echo "word $word"; done\n')
    executable.chmod(0o755)
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.pathsep.join(
        [str(root), os.environ.get('AMENT_PREFIX_PATH', '')]).rstrip(os.pathsep))
    return root


#: Runs a command a line: rclpy is imported once. It answers with the status and the output.
COMMANDS = '''
import contextlib, io, json, sys
from ros2cli.cli import main
answers = sys.stdout
for line in sys.stdin:
    sys.argv = ['ros2', *json.loads(line)]
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            status = main()
        except SystemExit as end:
            status = end.code
    if isinstance(status, str):  # as sys.exit() does
        status, _ = 1, output.write(status)
    print(json.dumps([status or 0, output.getvalue()]), file=answers, flush=True)
'''


@contextlib.contextmanager
def serving() -> Iterator[Callable[..., Any]]:
    """Yield what runs a command of ros2 in one process, and returns its status and output."""
    process = subprocess.Popen([sys.executable, '-c', COMMANDS], text=True,
                               stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin is not None and process.stdout is not None

    def run(*command: str) -> Any:
        process.stdin.write(json.dumps(command) + '\n')
        process.stdin.flush()
        return json.loads(process.stdout.readline())

    with process:
        yield run
        process.stdin.close()


@pytest.fixture(scope='module')
def commands() -> Callable[[], Any]:
    """Return :func:`serving`."""
    return serving
