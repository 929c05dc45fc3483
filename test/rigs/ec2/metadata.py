# SPDX-License-Identifier: Apache-2.0
"""
An instance's metadata service: IMDS at 169.254.169.254, version 2 where the instance asks for it.

Source: "Access instance metadata", Amazon EC2 User Guide: a token by PUT with its time to live in
seconds (1 to 21600), then every GET with it; without or with a stale one 401.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import http.server
import secrets
import socket
import socketserver
import threading
import time
from typing import Optional

from rigs.computers import netns
from rigs.computers.network import METADATA

_TOKENS_PATH = '/latest/api/token'
_LONGEST = 21600


class MetadataService:
    """
    Answers in one instance's namespace.

    :param space: the instance's network namespace.
    :param values: called for each question; what is below ``/latest/`` by path, asked anew each
        time as an interruption may be announced at any moment.
    :param tokens_required: HttpTokens of the instance's metadata options.
    """

    def __init__(
        self, space: str, values: Callable[[], Mapping[str, bytes]],
        tokens_required: Callable[[], bool],
    ) -> None:
        self.values = values
        self.tokens_required = tokens_required
        self.tokens: dict[str, float] = {}
        handler = type('Handler', (_Handler,), {'service': self})
        self._server = _Server(netns.listener(space, METADATA, 80), handler)
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,),
                                        daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering."""
        self._server.shutdown()
        self._server.server_close()


class _Server(socketserver.ThreadingMixIn, socketserver.TCPServer):
    daemon_threads = True

    def __init__(
        self, listener: socket.socket, handler: type[http.server.BaseHTTPRequestHandler],
    ) -> None:
        super().__init__(('', 0), handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listener


class _Handler(http.server.BaseHTTPRequestHandler):
    service: MetadataService
    protocol_version = 'HTTP/1.1'
    timeout = 5.0

    def do_PUT(self) -> None:
        """Hand out a token."""
        life = str(self.headers.get('X-aws-ec2-metadata-token-ttl-seconds'))
        if self.path != _TOKENS_PATH:
            self._answer(405)
        elif self.headers.get('X-Forwarded-For'):
            self._answer(403)
        elif not life.isdigit() or not 1 <= int(life) <= _LONGEST:
            self._answer(400)
        else:
            token = secrets.token_urlsafe(40)
            self.service.tokens[token] = time.monotonic() + int(life)
            self._answer(200, token.encode())

    def do_GET(self) -> None:
        """Answer a question, if the token is good."""
        token: Optional[str] = self.headers.get('X-aws-ec2-metadata-token')
        if token is not None or self.service.tokens_required():
            if self.service.tokens.get(token or '', 0.0) < time.monotonic():
                self._answer(401)
                return
        values = self.service.values()
        path = self.path.partition('?')[0].removeprefix('/latest/').strip('/')
        if path in values:
            self._answer(200, values[path])
            return
        below = sorted({
            name.removeprefix(f'{path}/').partition('/')[0]
            + ('/' if '/' in name.removeprefix(f'{path}/') else '')
            for name in values if name.startswith(f'{path}/')})
        self._answer(200, '\n'.join(below).encode()) if below else self._answer(404)

    def _answer(self, code: int, data: bytes = b'') -> None:
        self.send_response(code)
        self.send_header('Content-Type', 'text/plain')
        self.send_header('Content-Length', str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""
