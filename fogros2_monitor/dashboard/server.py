# SPDX-License-Identifier: Apache-2.0
"""
Serves the page and its data on the loopback, to clients that have the token.

The token stands in the fragment of the page's address, which no browser sends: the page puts it
into a header of each request, which no other site's page can. ``Host`` has to be the loopback's
(a name that somebody has lead there is another site), and ``Origin``, where a browser says it, the
page's own. A browser that we start gets a ticket instead, which is exchanged for the token once:
other users of this computer see its command line.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import json
from pathlib import Path
import re
import secrets
import socket
import threading
import time
from typing import Any, Optional, Protocol
import urllib.parse

from fogros2.errors import FogError

#: The header with the token.
HEADER = 'X-Fogros2-Token'
#: Seconds that a question for news may wait, that a client may say nothing, and bytes of a wish.
PATIENCE, SILENCE, MOST = 15.0, 60.0, 10_000
#: Seconds for which a ticket can be exchanged, and what it begins with.
VALID, TICKET = 60.0, 'ticket-'
_REFUSAL = ('the token is missing or wrong: open the address that `ros2 fog dashboard` has '
            'printed')
PAGE = Path(__file__).with_name('page.html')


class Source(Protocol):
    """What is shown."""

    def state(self, after: int, timeout: float) -> dict[str, Any]:
        """Return the state as JSON values, once its version is above ``after``."""

    def log(self, machine: str, after: int) -> list[dict[str, Any]]:
        """Return a machine's log lines with numbers above ``after``."""

    def picture(self, stream: str) -> Optional[bytes]:
        """Return the last picture of a stream, by its id in the state, as JPEG."""

    def delete(self, machine: str, force: bool) -> None:
        """
        Begin to end a machine.

        :raises FogError: it can't be.
        """


class Dashboard:
    """
    The server; it answers from the moment it is made.

    :param port: of the loopback; 0 for any that is free.
    :raises OSError: the port is taken.
    """

    def __init__(self, source: Source, *, port: int = 0) -> None:
        self.source = source
        self.token = secrets.token_urlsafe(24)
        self._tickets: dict[str, float] = {}
        self._lock = threading.Lock()
        self.page = PAGE.read_bytes()
        self.policy = content_policy(self.page.decode())
        self._server = _Server(('127.0.0.1', port), self)
        self.port: int = self._server.server_address[1]
        self.hosts = (f'127.0.0.1:{self.port}', f'localhost:{self.port}')

    @property
    def url(self) -> str:
        """Address for a browser; everyone who knows it may look and delete."""
        return f'http://{self.hosts[0]}/#{self.token}'

    def url_with_ticket(self) -> str:
        """Return an address that lets in once, within a minute."""
        ticket = TICKET + secrets.token_urlsafe(24)
        with self._lock:
            self._tickets[ticket] = time.monotonic() + VALID
        return f'http://{self.hosts[0]}/#{ticket}'

    def exchange(self, ticket: str) -> Optional[str]:
        """Return the token for a ticket, None for one that has been used, or is too old."""
        with self._lock:
            valid = self._tickets.pop(ticket, 0.0)
        return self.token if time.monotonic() < valid else None

    def serve(self) -> None:
        """Answer until closed from another thread, or interrupted."""
        # a port of its own would have to be looked at for the end twice a second
        self._server.serve_forever(poll_interval=3600.0)

    def close(self) -> None:
        """Take no more requests."""
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], dashboard: Dashboard) -> None:
        self.dashboard = dashboard
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Leave out what a browser that goes away causes."""
        import sys
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Refused(Exception):
    """A request that isn't answered: status and why."""

    def __init__(self, status: HTTPStatus, why: str) -> None:
        super().__init__(why)
        self.status = status


class _Handler(BaseHTTPRequestHandler):
    protocol_version = 'HTTP/1.1'
    server_version, sys_version = 'fogros2', ''
    timeout = SILENCE
    server: _Server

    def setup(self) -> None:
        super().setup()
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: a terminal that serves a page shows its address."""

    def do_GET(self) -> None:
        """Answer a question."""
        self._answer(self._get)

    def do_POST(self) -> None:
        """Fulfil a wish."""
        self._answer(self._post)

    def _answer(self, do: Any) -> None:
        try:
            check_host(self.headers.get('Host'), self.headers.get('Origin'),
                       self.headers.get('Sec-Fetch-Site'), self.server.dashboard.hosts)
            path, _, query = self.path.partition('?')
            if path.startswith('/api/') and path != '/api/enter' and not hmac.compare_digest(
                    self.headers.get(HEADER, '').encode(),
                    self.server.dashboard.token.encode()):
                raise _Refused(HTTPStatus.UNAUTHORIZED, _REFUSAL)
            do(path, dict(urllib.parse.parse_qsl(query)))
        except _Refused as error:
            self.close_connection = True  # what it sent may not have been read
            self._json({'error': str(error)}, error.status)
        except FogError as error:
            self._json({'error': str(error.args[0]), 'hint': error.hint}, HTTPStatus.CONFLICT)

    def _get(self, path: str, query: dict[str, str]) -> None:
        source = self.server.dashboard.source
        if path == '/':
            self._send(self.server.dashboard.page, 'text/html; charset=utf-8')
        elif path == '/api/state':
            self._json(source.state(_number(query, 'after', -1), PATIENCE))
        elif path == '/api/log':
            self._json(source.log(query.get('machine', ''), _number(query, 'after', 0)))
        elif path == '/api/picture':
            picture = source.picture(query.get('of', ''))
            if picture is None:
                raise _Refused(HTTPStatus.NOT_FOUND, 'there is no picture of it')
            self._send(picture, 'image/jpeg')
        else:
            raise _Refused(HTTPStatus.NOT_FOUND, 'there is nothing of that name')

    def _post(self, path: str, query: dict[str, str]) -> None:
        dashboard = self.server.dashboard
        if path == '/api/enter':
            token = dashboard.exchange(self._wish('ticket')['ticket'])
            if token is None:
                raise _Refused(HTTPStatus.UNAUTHORIZED, _REFUSAL)
            self._json({'token': token})
        elif path == '/api/delete':
            wish = self._wish('name')
            force = wish.get('force', False)
            if not isinstance(force, bool):
                raise _Refused(HTTPStatus.BAD_REQUEST, "'force' is no wish: true or false")
            dashboard.source.delete(wish['name'], force)
            self._json({})
        else:
            raise _Refused(HTTPStatus.NOT_FOUND, 'there is nothing of that name')

    def _wish(self, key: str) -> dict[str, Any]:
        """Return the JSON object that came, with a text for ``key``."""
        length = self.headers.get('Content-Length', '')
        if not length.isdigit() or int(length) > MOST:
            raise _Refused(HTTPStatus.BAD_REQUEST, 'a wish has a length, and a small one')
        if self.headers.get_content_type() != 'application/json':
            raise _Refused(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, 'a wish is JSON')
        try:
            wish = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            wish = None
        if not isinstance(wish, dict) or not isinstance(wish.get(key), str):
            raise _Refused(HTTPStatus.BAD_REQUEST, f"a wish is an object with '{key}'")
        return wish

    def _json(self, data: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(json.dumps(data, separators=(',', ':')).encode(), 'application/json', status)

    def _send(self, data: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        for name, value in (
                ('Content-Type', kind), ('Content-Length', str(len(data))),
                ('Content-Security-Policy', self.server.dashboard.policy),
                ('X-Content-Type-Options', 'nosniff'), ('Referrer-Policy', 'no-referrer'),
                ('Cross-Origin-Resource-Policy', 'same-origin'),
                ('Cross-Origin-Opener-Policy', 'same-origin'), ('Cache-Control', 'no-store')):
            self.send_header(name, value)
        if self.close_connection:
            self.send_header('Connection', 'close')
        self.end_headers()
        self.wfile.write(data)


def check_host(
    host: Optional[str], origin: Optional[str], site: Optional[str], hosts: tuple[str, ...],
) -> None:
    """
    Hold a request against where it should come from.

    :param host: its ``Host``, with ``Origin`` and ``Sec-Fetch-Site`` where it has them.
    :param hosts: the server's own names, with their port.
    """
    if host not in hosts:
        raise _Refused(HTTPStatus.MISDIRECTED_REQUEST, 'this page is for the loopback alone')
    if origin is not None and origin != f'http://{host}':
        raise _Refused(HTTPStatus.FORBIDDEN, 'another site has no business here')
    if site not in (None, 'same-origin', 'none'):
        raise _Refused(HTTPStatus.FORBIDDEN, 'another site has no business here')


def content_policy(page: str) -> str:
    """Return a Content-Security-Policy that runs the page's own script and style and no other."""
    def sources(tag: str) -> str:
        return ' '.join(
            f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
            for text in re.findall(f'<{tag}>(.*?)</{tag}>', page, re.DOTALL))

    return (f"default-src 'none'; script-src {sources('script')}; style-src {sources('style')}; "
            "img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; "
            "form-action 'none'; frame-ancestors 'none'")


def _number(query: dict[str, str], key: str, default: int) -> int:
    try:
        return int(query.get(key, default))
    except ValueError:
        raise _Refused(HTTPStatus.BAD_REQUEST, f"'{key}' is no number") from None
