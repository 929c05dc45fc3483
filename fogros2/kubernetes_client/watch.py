# SPDX-License-Identifier: Apache-2.0
"""Watch objects of the API server."""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import queue
import socket
import threading
from typing import Any, Optional, Protocol

from fogros2.kubernetes_client.answers import ApiError, http_errors, parsed, refusal, Unreachable

#: Seconds of silence after which a watch is restarted, because its connection may be dead.
SILENCE = 240.0


class Server(Protocol):
    """The part of the API server's interface that a watch needs."""

    def send(
        self, method: str, path: str, body: Optional[Mapping[str, Any]], query: Mapping[str, Any],
        read: Optional[float], /,
    ) -> Any:
        """Send a request, and return urllib3's response with an unread body."""

    def passing(self, error: ApiError, /) -> bool:
        """Return whether the cause of an error may be a restart of the API server."""

    def lost(self) -> None:
        """Record that a connection was lost."""


class Watch:
    """
    One watch; its thread sends the request and reads the lines, so that callers can be cancelled.

    An API server that accepts the connection and sends nothing blocks only that thread.
    """

    def __init__(self, api: Server, path: str, query: Mapping[str, Any]) -> None:
        self._events: queue.SimpleQueue[tuple[str, dict[str, Any]]] = queue.SimpleQueue()
        self._refusal: Optional[ApiError] = None
        self._lock = threading.Lock()
        self._ended = False
        self._response: Any = None
        self._thread = threading.Thread(
            target=self._run, args=(api, path, query), name='fog-watch', daemon=True)
        self._thread.start()

    def _run(self, api: Server, path: str, query: Mapping[str, Any]) -> None:
        response = self._open(api, path, query)
        with self._lock:
            self._response = response
            ended = self._ended
        if response is not None and ended:
            response.close()
        elif response is not None:
            self._read(api, response)
        else:
            # Limits the retries during a restart of the API server to ten per second.
            threading.Event().wait(0.1)
        self._events.put(('CLOSED', {}))

    def _open(self, api: Server, path: str, query: Mapping[str, Any]) -> Any:
        try:
            response = api.send('GET', path, None, query, SILENCE)
            if response.status < 400:
                return response
            data = response.read(decode_content=True)
            response.release_conn()
        except Unreachable:
            return None
        except http_errors():
            return None
        said = refusal(response.status, parsed(data), data)
        if said.status != 410 and not api.passing(said):
            self._refusal = said
        return None

    def _read(self, api: Server, response: Any) -> None:
        rest = b''
        with contextlib.suppress(OSError, ValueError, AttributeError, *http_errors()):
            for data in response.stream(1 << 16):
                *lines, rest = (rest + data).split(b'\n')
                for line in lines:
                    event = parsed(line)
                    if 'type' in event:
                        self._events.put((event['type'], event.get('object') or {}))
        if not self._ended:
            api.lost()  # or the API server closed the watch regularly; this call is then harmless

    def get(self, timeout: float) -> Optional[tuple[str, dict[str, Any]]]:
        """
        Return the next event, None after ``timeout`` seconds.

        :raises ApiError: the API server refused the watch.
        """
        try:
            event = self._events.get(timeout=timeout)
        except queue.Empty:
            return None
        if event[0] == 'CLOSED' and self._refusal is not None:
            raise self._refusal
        return event

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._ended = True
            response, self._response = self._response, None
        if response is None:
            return  # the watch has ended, or its thread will close the response
        with contextlib.suppress(OSError, RuntimeError, ValueError, AttributeError):
            _wake(response)
        self._thread.join(2.0)
        response.close()


def _wake(response: Any) -> None:
    """Wake the thread that reads a response; close() would wait for that thread."""
    if hasattr(response, 'shutdown'):
        response.shutdown()
        return
    # urllib3 before 2.3, as in Debian 12 and Ubuntu 24.04
    held = getattr(response.connection, 'sock', None)
    if held is None:
        held = response._fp.fp.raw._sock
    held.shutdown(socket.SHUT_RDWR)
