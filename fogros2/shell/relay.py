# SPDX-License-Identifier: Apache-2.0
"""Relay local streams over a channel: rsync's (``rsh.py`` is its end) or a terminal's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import os
from pathlib import Path
import select
import socket
import sys
import threading

from fogros2.errors import FogError
from fogros2.shell import lines
from fogros2.shell.lines import Channel

#: The value of rsync's ``-e``. rsync splits it into words, so it contains no value; the values
#: are in variables.
RSH = """sh -c 'exec "$FOGROS2_PYTHON" -I -S "$FOGROS2_RSH" "$FOGROS2_LINK" "$@"' sh"""
#: Variables of rsync, without any for this computer; files that it inherits; errors.
RemoteShell = tuple[Mapping[str, str], Sequence[int], list[FogError]]


@contextlib.contextmanager
def remote_shell(run: Callable[[str, int, int, int], int]) -> Iterator[RemoteShell]:
    """
    Yield how rsync reaches a machine, by ``RSH``.

    :param run: runs a command line on the machine with a standard input, output and error, until
        it ends; returns its exit status, at most 255.
    """
    failures: list[FogError] = []
    ours, theirs = socket.socketpair()
    thread = threading.Thread(
        target=_serve, args=(ours, run, failures), name='fog-rsync', daemon=True)
    with ours, theirs:
        thread.start()
        try:
            yield {
                'FOGROS2_PYTHON': sys.executable,
                'FOGROS2_RSH': str(Path(__file__).with_name('rsh.py')),
                'FOGROS2_LINK': str(theirs.fileno())}, [theirs.fileno()], failures
        finally:
            theirs.shutdown(socket.SHUT_RDWR)  # wakes the thread if rsync never called its end
            thread.join(5.0)


def _serve(
    link: socket.socket, run: Callable[[str, int, int, int], int], failures: list[FogError],
) -> None:
    line, streams, _, _ = socket.recv_fds(link, 1 << 16, 3)
    for stream in streams:
        os.set_blocking(stream, True)  # rsync may have set its own ends otherwise
    try:
        if len(streams) == 3:
            link.sendall(bytes([run(line.decode(), *streams)]))
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
        poll = select.poll()  # unlike select(), it takes descriptors above 1023
        for source in (stdin, ended):
            poll.register(source, select.POLLIN)
        with contextlib.suppress(OSError, FogError):
            while ended not in (ready for ready, _ in poll.poll()):
                # Large reads save system calls; sendall() splits them into packets.
                data = os.read(stdin, 1 << 18)
                if not data:
                    channel.shutdown_write()
                    return
                channel.sendall(data)

    def errors() -> None:
        with contextlib.suppress(OSError):
            while data := _received(channel.recv_stderr, 1 << 15):
                _write(stderr, data)

    threads = [threading.Thread(target=up, name='fog-relay-up', daemon=True),
               threading.Thread(target=errors, name='fog-relay-errors', daemon=True)]
    channel.settimeout(None)
    try:
        with contextlib.ExitStack() as undo:
            undo.callback(lines.close, channel)
            for thread in threads:
                thread.start()
            while data := _received(channel.recv, 1 << 18):
                _write(stdout, data)
            threads[1].join(5.0)
            status = int(channel.recv_exit_status())
    finally:
        os.close(end)  # wakes the thread that reads standard input
        threads[0].join(5.0)
        os.close(ended)
    return status if 0 <= status < 256 else 255


def _received(receive: Callable[[int], bytes], size: int) -> bytes:
    """Return the next bytes, b'' at the end and if the connection is gone."""
    with contextlib.suppress(ConnectionError):
        return receive(size)
    return b''


def _write(target: int, data: bytes) -> None:
    while data:
        data = data[os.write(target, data):]
