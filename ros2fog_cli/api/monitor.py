# SPDX-License-Identifier: Apache-2.0
"""A machine's bridge to Foxglove, as the command line reaches it."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import http.client
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
import secrets
import socket
import threading
import time
from typing import Optional
import urllib.parse

from fogros2 import monitor_addresses
from fogros2.deploy.guarding import AGENT_FOLDER
from fogros2.errors import AgentError, CommandError, ConfigurationError
from fogros2.model import Command
from fogros2.shell import Shell
from fogros2.store import Store
from fogros2_monitor import credentials
from fogros2_monitor.tunnel import Tunnel
from ros2fog_cli.api import machines
from ros2fog_cli.api.machines import Entry

#: Seconds in which the machine's gate has to answer.
_PATIENCE = 15.0
#: Seconds within which a browser that we start has to come.
_VALID = 60.0


@contextlib.contextmanager
def carrying(tunnel: Tunnel) -> Iterator[threading.Event]:
    """Have a tunnel take connections, in threads; yield an event that is set when it doesn't."""
    ended = threading.Event()

    def carry() -> None:
        tunnel.serve()
        ended.set()

    thread = threading.Thread(target=carry, name='fog-monitor', daemon=True)
    thread.start()
    try:
        yield ended
    finally:
        tunnel.close()
        thread.join(5.0)


class Ticket:
    """
    An address of the loopback that leads a browser to a page, once and within a minute.

    A page's own address has the token, and other users of this computer see the command line of a
    browser that is started with it.

    :param page: the address that it leads to.
    """

    def __init__(self, page: str) -> None:
        target = f'/{secrets.token_urlsafe(24)}'
        until = time.monotonic() + _VALID
        #: Set when a browser was led there.
        self.used = used = threading.Event()
        once = threading.Lock()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                # the lock is never given back
                valid = (self.path == target and time.monotonic() < until
                         and once.acquire(blocking=False))
                self.send_response(303 if valid else 404)
                if valid:
                    used.set()
                    self.send_header('Location', page)
                self.send_header('Cache-Control', 'no-store')
                self.send_header('Content-Length', '0')
                self.end_headers()

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing: the terminal shows the pages."""

        # browsers open connections ahead, and send nothing there
        self._server = ThreadingHTTPServer(('127.0.0.1', 0), Handler)
        self.url = f'http://127.0.0.1:{self._server.server_port}{target}'
        self._thread = threading.Thread(
            target=self._server.serve_forever, name='fog-ticket', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Lead nobody there any more."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


@contextlib.contextmanager
def browser_at(page: str, *, start: bool) -> Iterator[threading.Event]:
    """
    Start a browser that shows a page, without the page's address on its command line.

    Yields an event that is set when it came, or there is none to wait for.

    :param start: False for none.
    """
    import webbrowser
    with contextlib.closing(Ticket(page)) as ticket:
        if not start or not webbrowser.open(ticket.url):
            ticket.used.set()
        yield ticket.used


def has_application(port: int, token: str) -> bool:
    """Return whether the gate at a port of the loopback has the web application behind it."""
    connection = http.client.HTTPConnection('localhost', port, timeout=_PATIENCE)
    with contextlib.closing(connection):
        try:
            connection.request('GET', f'/?{urllib.parse.urlencode({"token": token})}')
            answer = connection.getresponse()
        except (OSError, http.client.HTTPException):
            return False  # the tunnel says what is wrong
        # to the application, without the token in its address
        return answer.status == 303


def on_robot(name: str) -> Optional[tuple[int, str]]:
    """Return port and token of the bridge of a machine that is this computer, None without."""
    folder = monitor_addresses.on_robot(Store(), name)
    for path in folder.glob('monitor-*/*/token'):
        port = int(path.parts[-3].partition('-')[2])
        with contextlib.suppress(OSError), socket.create_connection(
                ('127.0.0.1', port), timeout=_PATIENCE):
            return port, path.read_text().strip()
    return None


def token_of(entry: Entry, shell: Shell, port: int) -> str:
    """
    Return the token of the bridge at a machine's port.

    :raises AgentError: no bridge has made one.
    """
    record = entry.record
    folder = (record.agent if record is not None else '') \
        or machines.load(entry.provider).agent_directory or f'{AGENT_FOLDER}/{entry.name}'
    return _read(entry, shell, ('sh', '-c', 'cat "$1"/*/token', 'sh',
                                str(Path(monitor_addresses.folder_of(folder, port, '')))))


def credentials_of(entry: Entry, shell: Shell) -> tuple[str, str, str]:
    """
    Return where others reach the bridge (``host:port``), the token, the certificate's SHA-256.

    :raises ConfigurationError: nobody else is let in.
    :raises AgentError: this robot's launch isn't the one that lets them in.
    """
    record = entry.record
    if record is None or not record.monitor or not record.launch_alive or not record.agent:
        raise AgentError(f"no launch of this robot serves the topics of '{entry.name}' now",
                         'ros2 fog list shows whose it is')
    if not record.monitor_open:
        raise ConfigurationError(
            f"nobody but this robot may watch '{entry.name}'",
            "monitor_allow=['198.51.100.0/28'] in its launch file lets others in")
    made = credentials.Credentials(Path(
        monitor_addresses.folder_of(record.agent, record.monitor, record.launch)))
    said = _read(entry, shell, ('cat', str(made.token), str(made.certificate)))
    token, _, certificate = said.partition('\n')
    return record.monitor_open, token.strip(), credentials.fingerprint(certificate)


def _read(entry: Entry, shell: Shell, words: tuple[str, ...]) -> str:
    try:
        return shell.run(Command(words, sudo=True, what='read the token'),
                         timeout=_PATIENCE).stdout.strip()
    except CommandError as error:
        raise AgentError(f"'{entry.name}' has no token yet, or can't make one: {error}",
                         f'ros2 fog logs {entry.name}') from error
