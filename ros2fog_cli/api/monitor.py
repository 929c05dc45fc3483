# SPDX-License-Identifier: Apache-2.0
"""Connect the command line to the Foxglove bridge of a machine."""

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

#: Time-out of the answer of the machine's gate, in seconds.
_PATIENCE = 15.0
#: Seconds within which a started browser must open the ticket's address.
_VALID = 60.0


@contextlib.contextmanager
def carrying(tunnel: Tunnel) -> Iterator[threading.Event]:
    """Serve a tunnel in a thread; yield an event that is set when the tunnel ends."""
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
    A loopback URL that redirects a browser to a page, once and within a minute.

    The page's own URL contains the token. Other users of this computer could read that URL in
    the command line of the started browser.

    :param page: URL of the page.
    """

    def __init__(self, page: str) -> None:
        target = f'/{secrets.token_urlsafe(24)}'
        until = time.monotonic() + _VALID
        #: Set when a browser was redirected.
        self.used = used = threading.Event()
        once = threading.Lock()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                # The lock is never released, so only one request gets the page.
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
                """Log nothing: the terminal shows the pages."""

        # Threads, because browsers open connections in advance that send no request.
        self._server = ThreadingHTTPServer(('127.0.0.1', 0), Handler)
        self.url = f'http://127.0.0.1:{self._server.server_port}{target}'
        self._thread = threading.Thread(
            target=self._server.serve_forever, name='fog-ticket', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


@contextlib.contextmanager
def browser_at(page: str, *, start: bool) -> Iterator[threading.Event]:
    """
    Start a browser that shows a page, without the page's URL on its command line.

    Yield an event that is set when the browser came, or when no browser was started.

    :param start: False: start no browser.
    """
    import webbrowser
    with contextlib.closing(Ticket(page)) as ticket:
        if not start or not webbrowser.open(ticket.url):
            ticket.used.set()
        yield ticket.used


def has_application(port: int, token: str) -> bool:
    """Return whether the gate at a loopback port serves the web application."""
    connection = http.client.HTTPConnection('localhost', port, timeout=_PATIENCE)
    with contextlib.closing(connection):
        try:
            connection.request('GET', f'/?{urllib.parse.urlencode({"token": token})}')
            answer = connection.getresponse()
        except (OSError, http.client.HTTPException):
            return False  # the tunnel reports the error
        # The gate redirects to the application, to remove the token from the URL.
        return answer.status == 303


def on_robot(name: str) -> Optional[tuple[int, str]]:
    """Return port and token of the bridge of a machine that this robot replaces, or None."""
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

    :raises AgentError: no bridge has created a token.
    """
    record = entry.record
    folder = (record.agent if record is not None else '') \
        or machines.load(entry.provider).agent_directory or f'{AGENT_FOLDER}/{entry.name}'
    return _read(entry, shell, ('sh', '-c', 'cat "$1"/*/token', 'sh',
                                str(Path(monitor_addresses.folder_of(folder, port, '')))))


def credentials_of(entry: Entry, shell: Shell) -> tuple[str, str, str]:
    """
    Return the open address of the bridge (``host:port``), its token, its certificate's SHA-256.

    :raises ConfigurationError: the bridge is not open to other computers.
    :raises AgentError: no running launch of this robot serves the bridge, or it has no token yet.
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
