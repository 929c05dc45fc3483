# SPDX-License-Identifier: Apache-2.0
"""Recognise clients that other accounts of this computer run."""

from __future__ import annotations

import os
from pathlib import Path
import socket
import sys


def is_foreign(connection: socket.socket) -> bool:
    """
    Return whether another account of this computer, root aside, opened a TCP connection.

    Such a client could use up the connections of a server that checks a token only later.
    """
    try:
        peer, own = (_form(name) for name in (connection.getpeername(), connection.getsockname()))
        for line in Path('/proc/net/tcp').read_text().splitlines()[1:]:
            _, local, remote, *_, user = line.split()[:8]
            if (local, remote) == (peer, own):
                return int(user) not in (0, os.getuid())
    except OSError:
        pass  # the client has gone, or it is an IPv6 one
    return False


def _form(name: tuple[str, int]) -> str:
    """Return an address and a port as the kernel lists them."""
    number = int.from_bytes(socket.inet_aton(name[0]), sys.byteorder)
    return f'{number:08X}:{name[1]:04X}'
