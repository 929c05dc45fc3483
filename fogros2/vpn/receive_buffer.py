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
import sys
import time

#: Buffer size in bytes that newer releases of wireguard-go request.
SIZE = 7 << 20
#: Seconds that wireguard-go may need to open its sockets.
TIMEOUT = 2.0
#: <asm-generic/unistd.h>, and names and values of <asm-generic/socket.h> and <bits/socket.h>.
# Python's socket module has some, and takes longer to load than all of this program.
_PIDFD_GETFD, _SOL_SOCKET, _SO_TYPE, _SO_DOMAIN, _SO_RCVBUFFORCE = 438, 1, 3, 39, 33
_SOCK_DGRAM, _AF_INET, _AF_INET6 = 2, 2, 10
_libc = ctypes.CDLL(None, use_errno=True)


def processes(interface: str) -> Iterator[int]:
    """Yield the wireguard-go processes of an interface in this network namespace."""
    here = os.stat('/proc/self/ns/net').st_ino
    for name in filter(str.isdigit, os.listdir('/proc')):
        try:
            with open(f'/proc/{name}/cmdline', 'rb') as file:
                words = file.read().split(b'\0')
            if (words[:2] == [b'wireguard-go', interface.encode()]
                    and os.stat(f'/proc/{name}/ns/net').st_ino == here):
                yield int(name)
        except OSError:
            continue  # the process has ended


def sockets(process: int) -> Iterator[int]:
    """
    Yield copies of a process's UDP sockets.

    :raises OSError: this user, or this kernel, does not allow it.
    """
    descriptor = os.pidfd_open(process)
    try:
        for name in os.listdir(f'/proc/{process}/fd'):
            if not os.readlink(f'/proc/{process}/fd/{name}').startswith('socket:'):
                continue
            copy = _checked(_libc.syscall(_PIDFD_GETFD, descriptor, int(name), 0))
            try:
                if (_option(copy, _SO_TYPE) == _SOCK_DGRAM
                        and _option(copy, _SO_DOMAIN) in (_AF_INET, _AF_INET6)):
                    yield copy
            finally:
                os.close(copy)
    finally:
        os.close(descriptor)


def _option(number: int, option: int) -> int:
    value, size = ctypes.c_int(), ctypes.c_uint(4)
    _checked(_libc.getsockopt(
        number, _SOL_SOCKET, option, ctypes.byref(value), ctypes.byref(size)))
    return value.value


def _checked(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def enlarge(process: int) -> int:
    """Set the receive buffers of a process's UDP sockets; return the number of sockets."""
    count, size = 0, ctypes.c_int(SIZE)
    for number in sockets(process):
        _checked(_libc.setsockopt(
            number, _SOL_SOCKET, _SO_RCVBUFFORCE, ctypes.byref(size), ctypes.c_uint(4)))
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
