# SPDX-License-Identifier: Apache-2.0
"""An instance's metadata service: 169.254.169.254 with the header ``Metadata-Flavor: Google``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import http.server
import socket
import socketserver
import threading

from rigs.computers import netns
from rigs.computers.network import METADATA


class MetadataService:
    """
    Answers in one instance's namespace.

    :param space: the instance's network namespace.
    :param values: what is below ``/computeMetadata/v1/`` by path, asked anew each time.
    """

    def __init__(self, space: str, values: Callable[[], Mapping[str, str]]) -> None:
        handler = type('Handler', (_Handler,), {'values': staticmethod(values)})
        self._server = _Server(netns.listener(space, METADATA, 80), handler)
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

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
    values: Callable[[], Mapping[str, str]]
    timeout = 5.0

    def do_GET(self) -> None:
        """Answer a question that has the header."""
        path = self.path.partition('?')[0].removeprefix('/computeMetadata/v1/')
        found = self.values().get(path)
        if self.headers.get('Metadata-Flavor') != 'Google':
            status, text = 403, 'Missing Metadata-Flavor:Google header.'
        else:
            status, text = (200, found) if found is not None else (404, 'not found')
        data = text.encode()
        self.send_response(status)
        self.send_header('Metadata-Flavor', 'Google')
        self.send_header('Content-Length', str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""
