# SPDX-License-Identifier: Apache-2.0
"""
Write a program ``ros2`` with a separate daemon for one launch and its terminals.

``ros2 topic``, ``ros2 node`` and others use a daemon, which the first of them starts. Each ROS
domain of a computer has one, with the DDS configuration of the terminal that started it. A daemon
from before a launch never sees the launch's machines. A daemon with the configuration of a launch
fails in every terminal after the launch has ended. The program of this module runs ROS 2's own
``ros2`` with a daemon on another TCP port.
"""

from __future__ import annotations

import contextlib
from importlib.util import find_spec
import os
from pathlib import Path
import random
import shlex
import socket
import sys
from typing import Optional

from fogros2.errors import DeadlineExceeded, PrerequisiteError
from fogros2.store import write_private
from fogros2.waiting import wait_until

#: TCP ports above Linux's range for outgoing connections.
PORTS = range(61000, 65536)
#: Time-out of a daemon's answer and of its end, in seconds.
TIMEOUT = 5.0
#: Names in a folder: the file with the daemon's port, and the folder of the program.
PORT_FILE, PROGRAMS = 'ros2-daemon', 'bin'

# A command for sh, and a text for Python: a first line can't name a path that has a space.
_PROGRAM = """#!/bin/sh
'''exec' {python} "$0" "$@"
' '''
# ros2 with a daemon at a TCP port of its own
import sys

import ros2cli.daemon

ros2cli.daemon.get_port = lambda: int(open({port!r}).read())

from ros2cli.cli import main

sys.exit(main())
"""


def programs(folder: Path) -> Optional[Path]:
    """
    Return the folder to put first into PATH, so that ``ros2`` has the daemon of a launch.

    :param folder: the launch's.
    :returns: None where ROS 2's command line is missing, or has no daemon, as in the wheels.
    """
    if find_spec('ros2cli') is None or find_spec('ros2cli.daemon') is None:
        return None
    return install(folder, sys.executable)


def install(folder: Path, python: str) -> Path:
    """
    Write the program ``ros2`` below a folder, unless it exists; return the folder for PATH.

    :param python: interpreter with ros2cli.
    :raises PrerequisiteError: no TCP port is free.
    """
    program = folder / PROGRAMS / 'ros2'
    if not program.exists():
        port = folder.absolute() / PORT_FILE
        write_private(port, str(_free_port()).encode())
        write_private(program, _PROGRAM.format(
            python=shlex.quote(python), port=str(port)).encode())
        program.chmod(0o700)
    return program.parent


def stop(folder: Path) -> None:
    """
    Stop the daemon of a folder's program, and wait for its end; do nothing if none runs.

    The daemon is a ROS node, and must end before the VPN interface that it uses.
    """
    try:
        port = int((folder / PORT_FILE).read_text())
    except (OSError, ValueError):
        return
    if not _listens(port):
        return
    # Imported late, because these imports are slow and most launches do not need them.
    import http.client
    import xmlrpc.client
    connection = http.client.HTTPConnection('127.0.0.1', port, timeout=TIMEOUT)
    with contextlib.suppress(OSError, http.client.HTTPException, DeadlineExceeded), \
            contextlib.closing(connection):
        connection.request(
            'POST', '/ros2cli/', xmlrpc.client.dumps((), 'system.shutdown'),
            {'Content-Type': 'text/xml'})
        connection.getresponse().read(1 << 16)
        wait_until(lambda: not _listens(port), timeout=TIMEOUT, what='the daemon of ros2')


def _free_port() -> int:
    for port in random.SystemRandom().sample(PORTS, 50):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(('127.0.0.1', port))
            return port
    raise PrerequisiteError(
        f'no TCP port between {PORTS[0]} and {PORTS[-1]} is free for the daemon of ros2',
        "end programs that listen there: 'ss -ltn' lists them")


def _listens(port: int) -> bool:
    """Return whether a program of this account listens at a port of 127.0.0.1."""
    # local and remote end, state (0A listens), queues, timer, retransmissions, account
    sockets = map(str.split, Path('/proc/net/tcp').read_text().splitlines())
    return any((one[1], one[3], one[7]) == (f'0100007F:{port:04X}', '0A', str(os.getuid()))
               for one in sockets)
