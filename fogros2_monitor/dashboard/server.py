# SPDX-License-Identifier: Apache-2.0
"""
Serve the page and its data on the loopback interface, to clients that have the token.

The token is in the fragment of the page's URL, which browsers never send. The page puts the token
into a header of each request; pages of other sites cannot do that. ``Host`` must be a name of the
loopback interface, because an attacker can point another name to it. ``Origin``, if the browser
sends it, must be the page's own.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
import json
from pathlib import Path
import re
import secrets
import sys
from typing import Any, Optional, TYPE_CHECKING
import urllib.parse

from fogros2.errors import FogError
from fogros2_monitor import accounts

if TYPE_CHECKING:
    from ros2fog_cli.api.live import Live

#: The header with the token.
HEADER = 'X-Fogros2-Token'
#: Seconds to wait for a new state, idle time-out of a client in seconds, largest request in bytes.
TIMEOUT, SILENCE, MOST = 15.0, 60.0, 10_000
_REFUSAL = ('the token is missing or wrong: open the address that `ros2 fog dashboard` has '
            'printed')
PAGE = Path(__file__).with_name('page.html')


class Dashboard(accounts.OwnServer):
    """
    The HTTP server.

    :param port: port on the loopback interface; 0: any free port.
    :raises OSError: the port is in use.
    """

    def __init__(self, source: Live, *, port: int = 0) -> None:
        self.source = source
        self.token = secrets.token_urlsafe(24)
        self.page = PAGE.read_bytes()
        self.policy = content_policy(self.page.decode())
        super().__init__(port, _Handler)

    @property
    def hosts(self) -> tuple[str, ...]:
        """The server's own names with port."""
        return f'127.0.0.1:{self.server_port}', f'localhost:{self.server_port}'

    @property
    def url(self) -> str:
        """The URL for a browser; everyone who knows it can read the page and delete machines."""
        return f'http://{self.hosts[0]}/#{self.token}'

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of clients that disconnect."""
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Refused(Exception):
    """A refused request: HTTP status and reason."""

    def __init__(self, status: HTTPStatus, why: str) -> None:
        super().__init__(why)
        self.status = status


class _Handler(BaseHTTPRequestHandler):
    protocol_version = 'HTTP/1.1'
    server_version, sys_version = 'fogros2', ''
    timeout = SILENCE
    disable_nagle_algorithm = True
    server: Dashboard

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: the terminal shows the URL of the page."""

    def do_GET(self) -> None:
        """Answer a GET request."""
        self._answer(self._get)

    def do_POST(self) -> None:
        """Answer a POST request."""
        self._answer(self._post)

    def _answer(self, do: Any) -> None:
        try:
            check_host(self.headers.get('Host'), self.headers.get('Origin'),
                       self.headers.get('Sec-Fetch-Site'), self.server.hosts)
            path, _, query = self.path.partition('?')
            if path.startswith('/api/') and not hmac.compare_digest(
                    self.headers.get(HEADER, '').encode(),
                    self.server.token.encode()):
                raise _Refused(HTTPStatus.UNAUTHORIZED, _REFUSAL)
            do(path, dict(urllib.parse.parse_qsl(query)))
        except _Refused as error:
            self.close_connection = True  # the body may not have been read
            self._json({'error': str(error)}, error.status)
        except FogError as error:
            self._json({'error': str(error.args[0]), 'hint': error.hint}, HTTPStatus.CONFLICT)

    def _get(self, path: str, query: dict[str, str]) -> None:
        source = self.server.source
        if path == '/':
            self._send(self.server.page, 'text/html; charset=utf-8')
        elif path == '/api/state':
            self._json(source.state(_number(query, 'after', -1), TIMEOUT))
        elif path == '/api/log':
            self._json(source.log(query.get('machine', ''), _number(query, 'after', 0)))
        elif path == '/api/picture':
            picture = source.picture(query.get('of', ''))
            if picture is None:
                raise _Refused(HTTPStatus.NOT_FOUND, 'there is no picture of this stream')
            self._send(picture, 'image/jpeg')
        else:
            raise _Refused(HTTPStatus.NOT_FOUND, 'there is no such page')

    def _post(self, path: str, query: dict[str, str]) -> None:
        if path != '/api/delete':
            raise _Refused(HTTPStatus.NOT_FOUND, 'there is no such page')
        try:
            length = int(self.headers.get('Content-Length', ''))
        except ValueError:
            length = -1
        if not 0 <= length <= MOST:
            raise _Refused(HTTPStatus.BAD_REQUEST, 'the request needs a length, and a small one')
        if self.headers.get_content_type() != 'application/json':
            raise _Refused(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, 'the request must be JSON')
        try:
            request = json.loads(self.rfile.read(length))
        except (ValueError, RecursionError):
            request = None
        if not isinstance(request, dict) or not isinstance(request.get('name'), str):
            raise _Refused(HTTPStatus.BAD_REQUEST, "the request must be an object with 'name'")
        force = request.get('force', False)
        if not isinstance(force, bool):
            raise _Refused(HTTPStatus.BAD_REQUEST, "'force' in a request must be true or false")
        self.server.source.delete(request['name'], force)
        self._json({})

    def _json(self, data: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(json.dumps(data, separators=(',', ':')).encode(), 'application/json', status)

    def _send(self, data: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        for name, value in (
                ('Content-Type', kind), ('Content-Length', str(len(data))),
                ('Content-Security-Policy', self.server.policy),
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
    Check that a request comes from the page itself; raise _Refused otherwise.

    :param host: header ``Host``; ``origin`` is ``Origin``, ``site`` is ``Sec-Fetch-Site``.
    :param hosts: the server's own names with port.
    """
    if host not in hosts:
        raise _Refused(HTTPStatus.MISDIRECTED_REQUEST, 'this page is served on the loopback only')
    if origin is not None and origin != f'http://{host}':
        raise _Refused(HTTPStatus.FORBIDDEN, 'requests of other sites are refused')
    if site not in (None, 'same-origin', 'none'):
        raise _Refused(HTTPStatus.FORBIDDEN, 'requests of other sites are refused')


def content_policy(page: str) -> str:
    """Return a Content-Security-Policy that allows only the page's own script and style."""
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
