# SPDX-License-Identifier: Apache-2.0
"""Start a browser that shows a page, without the page's URL on the browser's command line."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
from http.server import BaseHTTPRequestHandler
import secrets
import threading
import time

from fogros2_monitor.accounts import OwnServer

#: Seconds within which a started browser must open the ticket's address.
_VALID = 60.0


class Ticket:
    """
    A loopback URL that redirects a browser to a page, once and within a minute.

    The page's own URL contains the token. Other users of this computer could read that URL in
    the command line of the started browser. They can read the ticket's URL there, and the server
    refuses their connections.

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

        server = OwnServer(0, Handler)
        self.url = f'http://127.0.0.1:{server.server_port}{target}'
        self.close = server.close


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
