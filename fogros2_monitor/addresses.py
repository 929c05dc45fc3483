# SPDX-License-Identifier: Apache-2.0
"""Addresses of a machine's bridge to Foxglove, and where its credentials are on the machine."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urlsplit

from fogros2.model import host_port
from fogros2.store import process_start, Store

#: Port on which viewers expect a bridge.
PORT = 8765
#: Lichtblick as a container, which serves HTTP on port 8080. By digest: it is what it was when it
#: was chosen, or it isn't taken.
IMAGE = ('ghcr.io/lichtblick-suite/lichtblick@sha256:'
         'ebaff0942173dc42c221ec0cc14d2bd7e6591e27c16cd11c8b2e557ce8da28d9')
#: What the record of a machine has of its bridge: the addresses for the robot, and for others.
NOTE, NOTE_OPEN = 'monitor', 'monitor_open'
#: What the name of the folder begins with that the credentials of one port are in.
CREDENTIALS = 'monitor-'
#: What stands for a launch's id in it on the robot: the launch's process.
_PROCESS = 'process-'


def gate_port(port: int) -> int:
    """Return the port at which others than the robot are let in, beside a bridge's own."""
    return port + 1


def application_port(port: int) -> int:
    """Return the port of the loopback that the web application has, beside a bridge's own."""
    return port + 2


def loopback(port: int) -> str:
    """
    Return the address of a port of this computer.

    Not with ``localhost``: a browser may try ``[::1]`` first, where another account may listen.
    """
    return f'127.0.0.1:{port}'


def bridge(host: str, port: int) -> str:
    """Return a bridge's address without its token."""
    return f'ws://{host_port(host, port)}'


def port_of(notes: Mapping[str, str]) -> int:
    """Return the port of the bridge in a record's notes, 0 without one."""
    return urlsplit(notes.get(NOTE, '')).port or 0


def folder_of(agent: str, port: int, launch: str) -> str:
    """
    Return where a launch's credentials are on a machine.

    :param agent: the agent's folder there.
    :param port: the bridge's.
    """
    return f'{agent}/{CREDENTIALS}{port}/{launch}'


def on_robot(store: Store, name: str) -> Path:
    """Return the folder that stands for the agent's where the machine ``name`` is the robot."""
    return store.root / f'monitor-{name}'


def of_process(pid: int) -> str:
    """Return what stands for a launch's id on the robot, where several may have one name."""
    return f'{_PROCESS}{pid}'


def is_used(folder: Path) -> bool:
    """Return whether a launch that runs on the robot has its credentials in a folder."""
    pid = folder.name.removeprefix(_PROCESS)
    return pid != folder.name and pid.isdecimal() and process_start(int(pid)) is not None
