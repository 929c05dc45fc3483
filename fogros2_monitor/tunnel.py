# SPDX-License-Identifier: Apache-2.0
"""Forward a port of this computer's loopback interface to a machine's port, over its Shell."""

from __future__ import annotations

import base64
from collections.abc import Callable
import contextlib
import socket
import threading

from fogros2.errors import FogError
from fogros2.model import Command
from fogros2.shell import Shell, Stream
from fogros2_monitor import accounts

#: Bytes in one line of base64.
_BLOCK = 32768
#: Every Shell can send lines, so each block becomes a line. The first line reports a connection.
_PROGRAM = """\
import base64, os, socket, sys, threading
try:
    link = socket.create_connection((sys.argv[1], int(sys.argv[2])), 10)
except OSError as error:
    sys.exit(str(error))
link.settimeout(None)
print(flush=True)
def up():
    for line in sys.stdin.buffer:
        link.sendall(base64.b64decode(line))
    os._exit(0)
threading.Thread(target=up, daemon=True).start()
while True:
    block = link.recv(int(sys.argv[3]))
    if not block:
        break
    sys.stdout.buffer.write(base64.b64encode(block) + b'\\n')
    sys.stdout.buffer.flush()
"""


class Tunnel:
    """
    Accept connections on this computer's loopback interface, and forward them to a machine.

    :param shell: shell of the machine; each connection runs one program there.
    :param to: host and port, as the machine sees them.
    :param port: port of this computer; 0: any free port.
    :param say: callback for errors of a connection.
    :raises OSError: the port is in use.
    """

    def __init__(
        self, shell: Shell, to: tuple[str, int], *, port: int = 0,
        say: Callable[[str], None] = print,
    ) -> None:
        self._shell = shell
        self._to = to
        self._say = say
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._listener = socket.create_server(('127.0.0.1', port))
        self.port: int = self._listener.getsockname()[1]
        #: Set when no connection is accepted any more.
        self.ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name='fog-monitor', daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                link, _ = self._listener.accept()
            except OSError:
                self.ended.set()
                return
            if accounts.is_foreign(link):  # each connection runs a program on the machine
                link.close()
                continue
            with self._lock:
                self._open.add(link)
            threading.Thread(target=self._carry, args=(link,), name='fog-tunnel',
                             daemon=True).start()

    def close(self) -> None:
        """Close all connections, and stop accepting."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes accept()
        self._listener.close()
        with self._lock:
            for link in self._open:
                with contextlib.suppress(OSError):
                    link.shutdown(socket.SHUT_RDWR)
        self._thread.join()

    def _carry(self, link: socket.socket) -> None:
        host, port = self._to
        try:
            with link, contextlib.closing(self._shell.open(Command(
                    ('python3', '-ISc', _PROGRAM, host, str(port), str(_BLOCK)),
                    what='reach a port'))) as stream:
                if not stream.readline():
                    self._say(f'nothing answers at {host}:{port} there')
                    return
                threading.Thread(target=_up, args=(link, stream), daemon=True).start()
                try:
                    while line := stream.readline():
                        link.sendall(base64.b64decode(line))
                finally:
                    with contextlib.suppress(OSError):
                        link.shutdown(socket.SHUT_RDWR)  # the other thread reads from it
        except FogError as error:
            self._say(str(error))
        except ValueError:
            self._say(f'{host}:{port} there sends no base64')
        except OSError:
            pass  # the viewer disconnected
        finally:
            with self._lock:
                self._open.discard(link)


def _up(link: socket.socket, stream: Stream) -> None:
    with contextlib.suppress(OSError, FogError), contextlib.closing(stream):
        while block := link.recv(_BLOCK):
            stream.write(base64.b64encode(block) + b'\n')
