# SPDX-License-Identifier: Apache-2.0
"""Sockets of this process that live in another network namespace."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path
import socket
import threading

FOLDER = Path('/run/netns')
_CLONE_NEWNET = 0x40000000


def listener(space: str, address: str, port: int, *, backlog: int = 64) -> socket.socket:
    """
    Return a TCP socket that listens in the namespace ``space``, served by this process.

    A socket stays in the namespace that its thread was in when it was made (setns(2)), so a
    thread that lives for this alone goes over.

    :raises OSError: there is no such namespace or address, or this process isn't root.
    """
    made: list[socket.socket] = []
    trouble: list[OSError] = []

    def make() -> None:
        try:
            _enter(space)
            made.append(socket.create_server((address, port), backlog=backlog))
        except OSError as error:
            trouble.append(error)

    thread = threading.Thread(target=make)
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
