# SPDX-License-Identifier: Apache-2.0
"""Serve a WSGI application of a test, without a log."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import threading
from typing import Any


def server(app: Any, host: str = '127.0.0.1', port: int = 0, **words: Any) -> Any:
    """Return a server that listens; ``words`` are those of Werkzeug's ``make_server``."""
    from werkzeug.serving import make_server, WSGIRequestHandler

    class Quiet(WSGIRequestHandler):
        protocol_version = 'HTTP/1.1'

        def log(self, *_: Any) -> None:
            """Say nothing."""

    return make_server(host, port, app, threaded=True, request_handler=Quiet, **words)


@contextlib.contextmanager
def serve(app: Any, **words: Any) -> Iterator[str]:
    """Serve an application on the loopback in the block; yields its address."""
    one = server(app, **words)
    thread = threading.Thread(target=one.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield f"http{'s' if 'ssl_context' in words else ''}://127.0.0.1:{one.port}"
    finally:
        one.shutdown()
        thread.join()
        one.server_close()
