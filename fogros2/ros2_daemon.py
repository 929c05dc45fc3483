# SPDX-License-Identifier: Apache-2.0
"""
A ``ros2`` whose daemon belongs to one launch, or to one shell.

``ros2 topic``, ``ros2 node`` and others ask a daemon, which the first of them starts. There is one
for each ROS domain of a computer, and it keeps the DDS configuration of the terminal that started
it. So a daemon that was there before a launch never sees the launch's machines. One that was
started with the configuration of a launch fails for every terminal when the launch has ended. The
program that this module writes runs ROS 2's own ``ros2`` with a daemon at another TCP port.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
import random
import socket

from fogros2.errors import DeadlineExceeded, PrerequisiteError
from fogros2.store import write_private
from fogros2.waiting import wait_until

#: TCP ports above those that Linux gives to connections.
PORTS = range(61000, 65536)
#: Seconds that a daemon may take to answer, and to end.
PATIENCE = 5.0
#: In a folder: the port of its daemon, and the folder of the program.
PORT_FILE, PROGRAMS = 'ros2-daemon', 'bin'

_PROGRAM = '''#!{python}
# ros2 with a daemon at a TCP port of its own
import sys

import ros2cli.daemon

ros2cli.daemon.get_port = lambda: {port}

from ros2cli.cli import main

sys.exit(main())
'''


def install(folder: Path, python: str) -> Path:
    """
    Write the program ``ros2`` below a folder, unless it is there; return what belongs into PATH.

    :param python: interpreter that finds ros2cli.
    :raises PrerequisiteError: no TCP port is free.
    """
    program = folder / PROGRAMS / 'ros2'
    if not program.exists():
        port = _free_port()
        write_private(folder / PORT_FILE, str(port).encode())
        write_private(program, _PROGRAM.format(python=python, port=port).encode())
        program.chmod(0o700)
    return program.parent


def stop(folder: Path) -> None:
    """
    Stop the daemon of a folder's program, and wait for its end; do nothing where none runs.

    It is a ROS node. Where it uses a VPN interface it has to end before the interface.
    """
    try:
        port = int((folder / PORT_FILE).read_text())
    except (OSError, ValueError):
        return
    if not _listens(port):
        return
    # takes longer to load than most launches have use for
    import http.client
    import xmlrpc.client
    connection = http.client.HTTPConnection('127.0.0.1', port, timeout=PATIENCE)
    with contextlib.suppress(OSError, http.client.HTTPException, DeadlineExceeded), \
            contextlib.closing(connection):
        connection.request(
            'POST', '/ros2cli/', xmlrpc.client.dumps((), 'system.shutdown'),
            {'Content-Type': 'text/xml'})
        connection.getresponse().read()
        wait_until(lambda: not _listens(port), timeout=PATIENCE, what='the daemon of ros2')


def _free_port() -> int:
    for port in random.SystemRandom().sample(PORTS, 50):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(('127.0.0.1', port))
            return port
    raise PrerequisiteError(
        f'no TCP port between {PORTS[0]} and {PORTS[-1]} is free for the daemon of ros2',
        "end programs that listen there: 'ss -ltn' lists them")


def _listens(port: int) -> bool:
    try:
        socket.create_connection(('127.0.0.1', port), timeout=PATIENCE).close()
    except OSError:
        return False
    return True
