# SPDX-License-Identifier: Apache-2.0
"""A machine's metadata service: Azure's IMDS at 169.254.169.254, with its header and versions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import http.server
import json
import threading
from typing import Any
from urllib.parse import parse_qs, urlsplit

from rigs.computers import netns
from rigs.computers.network import METADATA

#: Returns the answer to a path, None for none: status and JSON.
Answers = Callable[[str, Mapping[str, list[str]]], tuple[int, Any]]


class MetadataService:
    """
    Answers in one machine's namespace.

    :param answers: called for each request, with the path below ``/metadata/``.
    """

    def __init__(self, space: str, answers: Answers) -> None:
        class Handler(http.server.BaseHTTPRequestHandler):
            timeout = 5.0

            def do_GET(self) -> None:
                """Answer a request that names a version and is no forwarded one."""
                parts = urlsplit(self.path)
                query = parse_qs(parts.query)
                if self.headers.get('Metadata') != 'true' or 'api-version' not in query \
                        or self.headers.get('X-Forwarded-For'):
                    status, answer = 400, {'error': 'Bad request'}
                else:
                    status, answer = answers(parts.path.removeprefix('/metadata/'), query)
                data = json.dumps(answer).encode()
                self.send_response(status)
                self.send_header('Content-Length', str(len(data)))
                self.end_headers()
                self.wfile.write(data)

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
