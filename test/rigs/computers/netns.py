# SPDX-License-Identifier: Apache-2.0
"""Sockets of this process that live in another network namespace."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import ctypes
import os
from pathlib import Path
import socket
import threading

FOLDER = Path('/run/netns')
_CLONE_NEWNET = 0x40000000


def listener(space: str, address: str, port: int) -> socket.socket:
    """
    Return a TCP socket that listens in the namespace ``space``, served by this process.

    :raises OSError: there is no such namespace or address, or this process isn't root.
    """
    return made_in(space, lambda: socket.create_server((address, port), backlog=64))


def answers(space: str, address: str, port: int) -> bool:
    """
    Return whether something in the namespace ``space`` can connect there by TCP at once.

    :raises OSError: there is no such namespace, or this process isn't root.
    """
    def connect() -> socket.socket:
        probe = socket.socket()
        probe.settimeout(0.5)
        with contextlib.suppress(OSError):
            probe.connect((address, port))
        return probe

    with made_in(space, connect) as probe:
        try:
            probe.getpeername()
        except OSError:
            return False
        return True


def made_in(space: str, make: Callable[[], socket.socket]) -> socket.socket:
    """
    Return a socket that was made in a namespace, which is a name or the path of its file.

    It stays in the one that its thread was in when it was made (setns(2)), so a thread that lives
    for this alone goes over.
    """
    made: list[socket.socket] = []
    trouble: list[OSError] = []

    def work() -> None:
        try:
            _enter(space)
            made.append(make())
        except OSError as error:
            trouble.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    if trouble:
        raise trouble[0]
    return made[0]


def _enter(space: str) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    handle = os.open(FOLDER / space, os.O_RDONLY | os.O_CLOEXEC)
    try:
        if library.setns(handle, _CLONE_NEWNET) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), space)
    finally:
        os.close(handle)
