# SPDX-License-Identifier: Apache-2.0
"""A program ``ros2`` with a daemon of its own, and the end of that daemon."""

from __future__ import annotations

from pathlib import Path
import socket
import subprocess
import sys
import threading
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

import pytest

from fogros2 import ros2_daemon
from fogros2.store import write_private

#: What of ROS 2's ros2cli the program uses.
ROS2CLI = {
    '__init__.py': '', 'daemon.py': 'def get_port():\n    return 11511\n',
    'cli.py': 'import sys, ros2cli.daemon\n\n\ndef main():\n'
              '    print(ros2cli.daemon.get_port(), *sys.argv[1:])\n    return 3\n'}


class Handler(SimpleXMLRPCRequestHandler):
    rpc_paths = ('/ros2cli/',)


def port_of(folder: Path) -> int:
    return int((folder / ros2_daemon.PORT_FILE).read_text())


def ros2(programs: Path) -> subprocess.CompletedProcess[str]:
    """Run the program in a terminal whose ros2cli prints the daemon's port."""
    library = programs / 'lib'
    (library / 'ros2cli').mkdir(parents=True)
    for name, text in ROS2CLI.items():
        (library / 'ros2cli' / name).write_text(text)
    return subprocess.run([programs / 'ros2', 'topic', 'list'], capture_output=True, text=True,
                          env={'PYTHONPATH': str(library)})


def test_program_gives_the_daemon_another_port(tmp_path: Path) -> None:
    programs = ros2_daemon.install(tmp_path / 'launch', sys.executable)
    done, port = ros2(programs), port_of(tmp_path / 'launch')
    assert port in ros2_daemon.PORTS
    assert (done.stdout, done.returncode) == (f'{port} topic list\n', 3), done.stderr
    assert (programs / 'ros2').stat().st_mode & 0o777 == 0o700


def test_path_of_the_interpreter_may_have_spaces(tmp_path: Path) -> None:
    python = tmp_path / "it's a folder/python"
    python.parent.mkdir()
    python.symlink_to(sys.executable)
    done = ros2(ros2_daemon.install(tmp_path / 'launch', str(python)))
    assert (done.stdout.endswith(' topic list\n'), done.returncode) == (True, 3), done.stderr


@pytest.mark.parametrize('name', ['launch', "it's a folder"])
def test_two_terminals_at_once_get_one_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str,
) -> None:
    others = [tmp_path / name]

    def write(path: Path, data: bytes) -> None:
        if path.name == 'ros2' and others:
            ros2_daemon.install(others.pop(), sys.executable)
        write_private(path, data)

    monkeypatch.setattr(ros2_daemon, 'write_private', write)
    done = ros2(ros2_daemon.install(tmp_path / name, sys.executable))
    assert done.stdout == f'{port_of(tmp_path / name)} topic list\n', done.stderr


def test_second_terminal_gets_the_same_port(tmp_path: Path) -> None:
    first = ros2_daemon.install(tmp_path, sys.executable)
    port = port_of(tmp_path)
    assert ros2_daemon.install(tmp_path, sys.executable) == first
    assert port_of(tmp_path) == port


def test_stop_waits_for_the_end_of_the_daemon(tmp_path: Path) -> None:
    ros2_daemon.install(tmp_path, sys.executable)
    server = SimpleXMLRPCServer(
        ('127.0.0.1', port_of(tmp_path)), Handler, logRequests=False, allow_none=True)

    def serve() -> None:
        with server:
            server.serve_forever(0.05)

    thread = threading.Thread(target=serve)
    server.register_function(
        lambda: threading.Thread(target=server.shutdown).start(), 'system.shutdown')
    thread.start()
    ros2_daemon.stop(tmp_path)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(('127.0.0.1', port_of(tmp_path)))
    thread.join(60)
    assert not thread.is_alive()


def test_stop_without_a_daemon_does_nothing(tmp_path: Path) -> None:
    ros2_daemon.stop(tmp_path)
    ros2_daemon.install(tmp_path, sys.executable)
    ros2_daemon.stop(tmp_path)
    (tmp_path / ros2_daemon.PORT_FILE).write_text('damaged')
    ros2_daemon.stop(tmp_path)


def test_stop_gives_up_on_a_silent_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ros2_daemon, 'TIMEOUT', 0.1)
    ros2_daemon.install(tmp_path, sys.executable)
    with socket.create_server(('127.0.0.1', port_of(tmp_path))):
        ros2_daemon.stop(tmp_path)
