# SPDX-License-Identifier: Apache-2.0
"""
Enlarge the receive buffers of ``wireguard-go`` to hold several raw images.

Releases before 2023 use the kernel's default of 208 kB: less than 100 packets, while a raw VGA
image has 720. A kernel setting would apply to all programs of the host. So this program copies the
process's sockets, which root may do (pidfd_getfd(2)), and sets their buffers.

Runs as python3 -c SOURCE NAME, where NAME is the interface; imports nothing of fogros2.
"""

from __future__ import annotations

from collections.abc import Iterator
import ctypes
import os
from pathlib import Path
import socket
import sys
import time

#: Buffer size in bytes that newer releases of wireguard-go request.
SIZE = 7 << 20
#: Seconds that wireguard-go may need to open its sockets.
TIMEOUT = 2.0
#: <asm-generic/unistd.h> and <asm-generic/socket.h>; Python has neither.
_PIDFD_GETFD, _SO_RCVBUFFORCE = 438, 33


def processes(interface: str) -> Iterator[int]:
    """Yield the wireguard-go processes of an interface in this network namespace."""
    here = os.stat('/proc/self/ns/net').st_ino
    for path in Path('/proc').glob('[0-9]*'):
        try:
            words = (path / 'cmdline').read_bytes().split(b'\0')
            if (words[:2] == [b'wireguard-go', interface.encode()]
                    and os.stat(path / 'ns/net').st_ino == here):
                yield int(path.name)
        except OSError:
            continue  # the process has ended


def sockets(process: int) -> Iterator[socket.socket]:
    """
    Yield copies of a process's UDP sockets.

    :raises OSError: this user, or this kernel, does not allow it.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    there = os.pidfd_open(process)
    try:
        for path in Path(f'/proc/{process}/fd').iterdir():
            if not os.readlink(path).startswith('socket:'):
                continue
            copy = libc.syscall(_PIDFD_GETFD, there, int(path.name), 0)
            if copy < 0:
                raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
            with socket.socket(fileno=copy) as one:
                if one.type == socket.SOCK_DGRAM and one.family in (
                        socket.AF_INET, socket.AF_INET6):
                    yield one
    finally:
        os.close(there)


def enlarge(process: int) -> int:
    """Set the receive buffers of a process's UDP sockets; return the number of sockets."""
    count = 0
    for one in sockets(process):
        one.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, SIZE)
        count += 1
    return count


def main() -> None:
    """Set the buffers of an interface's process when it has opened its sockets."""
    for process in processes(sys.argv[1]):
        end = time.monotonic() + TIMEOUT
        try:
            while not enlarge(process) and time.monotonic() < end:
                time.sleep(0.01)
        except OSError as error:
            raise SystemExit(f'receive buffer of wireguard-go: {error}') from error


if __name__ == '__main__':
    main()
