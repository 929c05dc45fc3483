# SPDX-License-Identifier: Apache-2.0
"""How long a request to a machine takes while a long transfer fills a link of 1 Mbit/s."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import socket
import subprocess
import sys
import tempfile
import threading
import time

from figures import Row, write

from fogros2.errors import FogError
from fogros2.model import Command, Endpoint
from fogros2.shell import multiplexed, multiplexer, remote, Shell, Stream
from fogros2.shell.ssh import SSHShell
from rigs.sshd import private_sshd

BYTES = 8 << 20
#: Requests of one measurement, and seconds of transfer before the first.
REQUESTS, BEFORE = 10, 3.0
TARGET = 1.0
RATE = ('tbf', 'rate', '1mbit', 'burst', '16kb', 'latency', '100ms')


class PodShell(remote.MultiplexedShell):
    """A pod's multiplexer behind a connection of loopback, without API server and kubelet."""

    def _connect(
        self, timeout: float, cancel: threading.Event | None,
    ) -> multiplexed.Link:
        with socket.create_server(('127.0.0.1', 0)) as server:
            ours = socket.create_connection(server.getsockname())
            theirs, _ = server.accept()
        theirs.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # as an API server does
        with theirs:
            subprocess.Popen([sys.executable, multiplexer.__file__], stdin=theirs, stdout=theirs)
        ours.settimeout(10.0)
        return multiplexed.Link(ours, self.name, self.user)


@contextlib.contextmanager
def shells() -> Iterator[dict[str, Shell]]:
    """Yield a shell of each kind to this computer."""
    with tempfile.TemporaryDirectory() as folder, private_sshd(Path(folder, 'sshd')) as server, \
            contextlib.closing(SSHShell(server.endpoint, name='machine')) as ssh, \
            contextlib.closing(PodShell(Endpoint('pod', 'pod', user='root'), name='pod')) as pod:
        yield {'SSH': ssh, "a pod's multiplexer": pod}


def answer(stream: Stream) -> float:
    """Return the seconds of one request."""
    begin = time.monotonic()
    stream.write(b'request\n')
    assert stream.readline() == b'request\n'
    return time.monotonic() - begin


def while_busy(shell: Shell, transfer: Command) -> list[float]:
    """Return the seconds of requests during a transfer."""
    cancel = threading.Event()
    stream = shell.open(Command(('cat',)))
    limit('add', *RATE)

    def run() -> None:
        with contextlib.suppress(FogError):
            shell.run(transfer, timeout=600, cancel=cancel)

    thread = threading.Thread(target=run)
    thread.start()
    time.sleep(BEFORE)
    times = [answer(stream) for _ in range(REQUESTS)]
    assert thread.is_alive(), 'the transfer ended before the requests'
    cancel.set()
    thread.join()
    limit('delete')
    stream.close()
    return times


def limit(change: str, *rate: str) -> None:
    """Set or remove the rate of the loopback interface."""
    subprocess.run(['tc', 'qdisc', change, 'dev', 'lo', 'root', *rate], check=True)


def main() -> None:
    """Measure on the loopback interface of a network namespace of its own."""
    if os.geteuid():
        print('not measured: the rate of a network namespace needs root')
        return
    if os.environ.get('FOGT_SLOW_LINK') is None:
        os.environ['FOGT_SLOW_LINK'] = 'yes'
        subprocess.run(['unshare', '--net', '--pid', '--fork', '--kill-child',
                        sys.executable, *sys.argv], check=True)
        return
    subprocess.run(['ip', 'link', 'set', 'lo', 'mtu', '1400', 'up'], check=True)
    rows = []
    with shells() as machines:
        for kind, shell in machines.items():
            ways = {
                'to the machine': Command(('sh', '-c', 'cat >/dev/null'), input=bytes(BYTES)),
                'to the robot': Command(('head', '-c', str(BYTES), '/dev/zero'))}
            for way, command in ways.items():
                rows.append(Row.of(f'{kind}, while 8 MB go {way}', while_busy(shell, command),
                                   's', TARGET))
    write('slow_link', 'A request over a link of 1 Mbit/s that a transfer fills', rows)


if __name__ == '__main__':
    main()
