# SPDX-License-Identifier: Apache-2.0
"""The metadata service of an instance, at 169.254.169.254; a cloud says what it answers."""

from __future__ import annotations

from collections.abc import Callable
from email.message import Message
import http.server
import threading

from rigs.computers import netns
from rigs.computers.network import METADATA

#: Returns status and text of the answer to a request: method, path with query, headers.
Answers = Callable[[str, str, Message], tuple[int, str]]


class MetadataService:
    """
    Answers in one instance's namespace.

    :param space: the instance's network namespace.
    :param answers: called for each request: an interruption may be announced at any moment.
    """

    def __init__(self, space: str, answers: Answers) -> None:
        class Handler(http.server.BaseHTTPRequestHandler):
            timeout = 5.0

            def do_GET(self) -> None:
                """Answer a request."""
                status, text = answers(self.command, self.path, self.headers)
                data = text.encode()
                self.send_response(status)
                self.send_header('Content-Length', str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            do_PUT = do_GET

            def log_message(self, *args: object) -> None:
                """Say nothing."""

        self._server = http.server.ThreadingHTTPServer(('', 0), Handler, False)
        self._server.socket.close()
        self._server.socket = netns.listener(space, METADATA, 80)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    def close(self) -> None:
        """Stop answering."""
        self._server.shutdown()
        self._server.server_close()
