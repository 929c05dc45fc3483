# SPDX-License-Identifier: Apache-2.0
"""Relay local streams over a channel: rsync's (``rsh.py`` is its end) or a terminal's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import os
from pathlib import Path
import secrets
import select
import socket
import struct
import sys
import threading

from fogros2.errors import FogError
from fogros2.shell.lines import Channel

_HELPER = Path(__file__).with_name('rsh.py')


@contextlib.contextmanager
def remote_shell(start: Callable[[str], Channel]) -> Iterator[tuple[str, list[FogError]]]:
    """
    Yield the value of rsync's ``-e``, and a list that collects errors of the relay.

    :param start: function that starts a command line on the machine.
    """
    failures: list[FogError] = []
    name = f'fogros2-{secrets.token_hex(16)}'
    listener = socket.socket(socket.AF_UNIX)
    listener.bind('\0' + name)
    listener.listen(1)
    thread = threading.Thread(
        target=_serve, args=(listener, start, failures), name='fog-rsync', daemon=True)
    thread.start()
    try:
        yield f"'{sys.executable}' -I -S '{_HELPER}' {name}", failures
    finally:
        with contextlib.suppress(OSError):
            listener.shutdown(socket.SHUT_RDWR)  # wakes accept() if rsync never connected
        listener.close()
        thread.join(5.0)


def _serve(
    listener: socket.socket, start: Callable[[str], Channel], failures: list[FogError],
) -> None:
    while True:
        try:
            link, _ = listener.accept()
        except OSError:
            return  # rsync ended before it connected
        with link:
            # Every account can list and connect to an abstract socket.
            peer = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize('3i'))
            if struct.unpack('3i', peer)[1] == os.geteuid():
                _serve_rsync(link, start, failures)
                return


def _serve_rsync(
    link: socket.socket, start: Callable[[str], Channel], failures: list[FogError],
) -> None:
    line, streams, _, _ = socket.recv_fds(link, 1 << 16, 3)
    try:
        if len(streams) == 3:
            link.sendall(bytes([relay(start(line.decode()), *streams)]))
    except FogError as error:
        failures.append(error)
    except OSError:
        pass  # rsync has ended; its own exit status has the reason
    finally:
        for stream in streams:
            os.close(stream)


def relay(channel: Channel, stdin: int, stdout: int, stderr: int) -> int:
    """Relay bytes until the remote program ends; return its exit status (255: lost)."""
    ended, end = os.pipe()

    def up() -> None:
        with contextlib.suppress(OSError, EOFError, FogError):
            while ended not in select.select([stdin, ended], [], [])[0]:
                # Large reads save system calls; sendall() splits them into packets.
                data = os.read(stdin, 1 << 18)
                if not data:
                    channel.shutdown_write()
                    return
                channel.sendall(data)

    def errors() -> None:
        with contextlib.suppress(OSError):
            while data := channel.recv_stderr(1 << 15):
                _write(stderr, data)

    threads = [threading.Thread(target=up, name='fog-relay-up', daemon=True),
               threading.Thread(target=errors, name='fog-relay-errors', daemon=True)]
    channel.settimeout(None)
    try:
        with contextlib.closing(channel):
            for thread in threads:
                thread.start()
            while data := channel.recv(1 << 18):
                _write(stdout, data)
            threads[1].join(5.0)
            status = int(channel.recv_exit_status())
    finally:
        os.close(end)  # wakes the thread that reads standard input
        threads[0].join(5.0)
        os.close(ended)
    return status if 0 <= status < 256 else 255


def _write(target: int, data: bytes) -> None:
    while data:
        data = data[os.write(target, data):]
