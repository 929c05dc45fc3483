# SPDX-License-Identifier: Apache-2.0
"""
Send requests to a cluster's API server, watch objects, and open the WebSocket of exec.

The official client reads the kubeconfig, gets and renews credentials, and sets TLS up. This module
sends requests by path and parses the JSON responses itself: the client's WebSocket has no
time-outs, and its watch cannot be cancelled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
import json
import math
import os
import queue
import threading
import time
from typing import Any, Optional, TYPE_CHECKING, TypeVar
from urllib.parse import urlencode, urlsplit

from fogros2.clock import ServerClock
from fogros2.errors import DeadlineExceeded, PrerequisiteError, ProviderError
from fogros2.kubernetes_client import configuration as kubeconfig
from fogros2.kubernetes_client.answers import (
    ApiError,
    http_errors,
    parsed,
    refusal,
    Unreachable,
)
from fogros2.kubernetes_client.configuration import words
from fogros2.waiting import cancellable, ON_ITS_WAY, wait_until

if TYPE_CHECKING:
    import websocket

T = TypeVar('T')
#: Query parameters; a list repeats the name.
Query = Mapping[str, Any]
#: ADDED, MODIFIED or DELETED, and the object; or CLOSED or ERROR.
Event = tuple[str, dict[str, Any]]

#: Time-out of a connection to the API server, in seconds.
CONNECT = 5.0
#: Time-out of one request, in seconds.
ANSWER = 30.0
#: Seconds to wait for an API server that restarts.
TIMEOUT = 30.0
#: Seconds after which the API server ends a watch, and another one follows. After twice as long
#: without an event, its connection is dead.
WATCH = 30
#: Seconds after a restart in which an API server may not have loaded its permissions yet.
DOUBT = 15.0


class Api:
    """
    The API server of one context; thread-safe.

    :param context: name of a context of the kubeconfig; '': the current one.
    :raises PrerequisiteError: no kubeconfig, no such context, or no valid credentials.
    """

    #: When ``doubt`` has last asked the server.
    _doubted = -math.inf

    def __init__(self, context: str = '') -> None:
        self.context, self.namespace, self._client = kubeconfig.load(context)
        self._renewing = threading.Lock()
        self._lost = -DOUBT
        self.clock = ServerClock()

    @property
    def server(self) -> str:
        """The API server's address."""
        return str(self._client.configuration.host)

    def headers(self) -> dict[str, str]:
        """Return the headers that authenticate a request; renew expired credentials."""
        return {each['key']: each['value']
                for each in self._client.configuration.auth_settings().values()
                if each['in'] == 'header' and each['value']}

    def _renewed(self, client: Any) -> bool:
        """
        After status 401, read the kubeconfig again: the user may have logged in again.

        The official client renews only the tokens of login programs.

        :param client: the client whose credentials the API server refused.
        :returns: whether there is another client for the same API server.
        """
        with self._renewing:
            if self._client is client:
                with contextlib.suppress(PrerequisiteError):
                    other = kubeconfig.load(self.context)[2]
                    if other.configuration.host == self.server:
                        self._client = other
            return self._client is not client

    # -- requests -------------------------------------------------------------------------------

    def request(
        self, method: str, path: str, body: Optional[Mapping[str, Any]] = None,
        *, timeout: float = TIMEOUT, doubt: float = 0.0,
        cancel: Optional[threading.Event] = None, **query: Any,
    ) -> dict[str, Any]:
        """
        Send a request, and return the response's JSON object.

        :param timeout: seconds for which to retry while the API server does not answer.
        :param doubt: seconds for which to retry after status 403 (Forbidden).
        :raises ApiError: the API server refused.
        :raises Unreachable: the API server does not answer.
        :raises Cancelled: ``cancel`` was set, and no answer came soon after.
        """
        last: list[ProviderError] = []
        sure = time.monotonic() + doubt
        end = time.monotonic() + timeout

        def attempt() -> Optional[dict[str, Any]]:
            answer = min(ANSWER, max(CONNECT, end - time.monotonic()))
            if not last and method != 'POST':
                # a dead connection of the pool leaves time for a new one
                answer = max(CONNECT, answer / 3)
            try:
                return cancellable(lambda: self._once(method, path, body, query, answer), cancel,
                                   what=f'asking the API server {self.server}',
                                   grace=lambda: 0.0 if method == 'GET' else ON_ITS_WAY)
            except Unreachable as error:
                last[:] = [error]
            except ApiError as error:
                if not self.passing(error) and not (
                        error.status == 403 and time.monotonic() < sure):
                    raise
                last[:] = [error]
            return None

        try:
            return wait_until(attempt, timeout=timeout, cancel=cancel, interval=0.1,
                              what=f'the API server {self.server}')
        except DeadlineExceeded as error:
            raise last[0] from error

    def passing(self, error: ApiError) -> bool:
        """
        Return whether the same request may succeed: the API server restarts, or counts several
        requests against a quota at once, and refuses all but one of them.
        """
        return error.status in (429, 500, 502, 503, 504) or (
            error.status == 403 and time.monotonic() - self._lost < DOUBT) or (
            error.reason == 'Conflict' and 'resourcequotas' in str(error.args[0]))

    def doubt(self, error: ApiError, path: str) -> None:
        """
        After a refusal, find out whether the API server has just started.

        :param path: of an object that this user may read; a new server refuses that, too.
        """
        now = time.monotonic()
        # once in a while: the user may really have no rights
        if error.status == 403 and now - self._doubted > 4 * DOUBT:
            self._doubted = now
            try:
                self.request('GET', path)
            except ApiError as other:
                if other.status == 403:
                    self.lost()

    def lost(self) -> None:
        """Record that a connection to the API server was lost or could not be opened."""
        self._lost = time.monotonic()

    def _once(
        self, method: str, path: str, body: Optional[Mapping[str, Any]], query: Query,
        answer: float,
    ) -> dict[str, Any]:
        response = self.send(method, path, body, query, answer)
        try:
            data = response.read(decode_content=True)
        except http_errors() as error:
            raise self._unreachable(error) from error
        finally:
            response.release_conn()
        reply = parsed(data)
        if response.status >= 400:
            raise refusal(response.status, reply, data)
        return reply

    def send(
        self, method: str, path: str, body: Optional[Mapping[str, Any]], query: Query,
        read: Optional[float],
    ) -> Any:
        """
        Send a request, and return urllib3's response with an unread body.

        :param read: time-out of silence in seconds; None: no time-out.
        :raises Unreachable: no response began.
        """
        client = self._client
        response = self._send(method, path, body, query, read)
        if response.status == 401 and self._renewed(client):
            response.release_conn()
            response = self._send(method, path, body, query, read)
        self.clock.note(response.headers.get('Date', ''))
        return response

    def _send(
        self, method: str, path: str, body: Optional[Mapping[str, Any]], query: Query,
        read: Optional[float],
    ) -> Any:
        import urllib3

        headers = {'accept': 'application/json', **self.headers()}
        if body is not None:
            headers['content-type'] = 'application/merge-patch+json' \
                if method == 'PATCH' else 'application/json'
        try:
            return self._client.rest_client.pool_manager.request(
                method, self._url(path, query), headers=headers, preload_content=False,
                body=None if body is None else json.dumps(body).encode(), retries=False,
                timeout=urllib3.Timeout(connect=CONNECT, read=read))
        except http_errors() as error:
            raise self._unreachable(error) from error

    def _url(self, path: str, query: Query) -> str:
        words = {name: value for name, value in query.items() if value is not None}
        text = urlencode(words, doseq=True)
        return f'{self.server}{path}?{text}' if text else f'{self.server}{path}'

    def _unreachable(self, error: BaseException) -> Unreachable:
        self.lost()
        return Unreachable(
            f'the API server {self.server} does not answer: {words(error)}',
            'is the cluster up, and reachable from this robot? `kubectl cluster-info` asks the '
            'same')

    # -- watches --------------------------------------------------------------------------------

    def follow(
        self, path: str, look: Callable[[str, dict[str, Any]], Optional[T]], *,
        timeout: float, what: str, cancel: Optional[threading.Event] = None,
        again: Optional[Callable[[], Optional[T]]] = None,
        tick: Optional[Callable[[], Optional[T]]] = None, **query: Any,
    ) -> T:
        """
        Watch objects until ``look`` returns something other than None, and return that.

        :param look: callback with ADDED, MODIFIED or DELETED and the object. Existing objects come
            as ADDED, unless ``resourceVersion`` names a start.
        :param again: called before a lost watch is restarted, to check the current state; a
            result other than None ends the watch.
        :param tick: called a few times per second, for deadlines of the caller; as ``again``.
        :raises DeadlineExceeded: after ``timeout`` seconds.
        :raises Cancelled: ``cancel`` was set.
        """
        events: Optional[queue.SimpleQueue[Event | ApiError]] = None
        lost = False

        def probe() -> Optional[tuple[T]]:
            nonlocal events, lost, query
            if events is None:
                if lost and again is not None and (result := again()) is not None:
                    return (result,)
                events = queue.SimpleQueue()
                # An API server that accepts the connection and sends nothing blocks this thread,
                # which ends some time after the watch.
                threading.Thread(target=self._watch, args=(path, query, events),
                                 name='fog-watch', daemon=True).start()
            with contextlib.suppress(queue.Empty):
                event = events.get(timeout=0.1)
                if isinstance(event, ApiError):
                    raise event
                if event[0] not in ('CLOSED', 'ERROR'):
                    result = look(*event)
                    return None if result is None else (result,)
                events, lost = None, True
                query = {k: v for k, v in query.items() if k != 'resourceVersion'}
            result = tick() if tick is not None else None
            return None if result is None else (result,)

        return wait_until(probe, timeout=timeout, what=what, cancel=cancel, interval=0.0)[0]

    def _watch(
        self, path: str, query: Query, events: queue.SimpleQueue[Event | ApiError],
    ) -> None:
        """Send a watch's request, and put its events into a queue; CLOSED is the last one."""
        try:
            response = self.send(
                'GET', path, None, {'watch': 'true', 'timeoutSeconds': WATCH, **query}, 2 * WATCH)
            if response.status >= 400:
                data = response.read(decode_content=True)
                error = refusal(response.status, parsed(data), data)
                if error.status != 410 and not self.passing(error):
                    events.put(error)
                raise error
            rest = b''
            for data in response.stream(1 << 16):
                *lines, rest = (rest + data).split(b'\n')
                for line in lines:
                    event = parsed(line)
                    if 'type' in event:
                        events.put((event['type'], event.get('object') or {}))
            response.release_conn()
        except (ApiError, Unreachable):
            # Limits the retries during a restart of the API server to ten per second.
            threading.Event().wait(0.1)
        except http_errors():
            self.lost()
        events.put(('CLOSED', {}))

    # -- exec -----------------------------------------------------------------------------------

    def _websocket(self, path: str, query: Query, timeout: float) -> websocket.WebSocket:
        import websocket

        options: dict[str, Any] = {}
        configuration = self._client.configuration
        if proxy := configuration.proxy:
            parts = urlsplit(proxy)
            # a proxy of SOCKS needs the package python-socks, as the error of websocket says
            options.update(http_proxy_host=parts.hostname, http_proxy_port=parts.port or 80,
                           http_proxy_timeout=timeout, proxy_type=(
                               parts.scheme if parts.scheme.startswith('socks') else 'http'))
            if parts.username:
                options['http_proxy_auth'] = (parts.username, parts.password or '')
        url = self._url(path, query).replace('http', 'ws', 1)
        try:
            return websocket.create_connection(
                url, timeout=timeout, sslopt=_tls(configuration), enable_multithread=False,
                header=[f'{name}: {value}' for name, value in self.headers().items()],
                subprotocols=['v4.channel.k8s.io'], skip_utf8_validation=True, **options)
        except websocket.WebSocketBadStatusException as error:
            data = getattr(error, 'resp_body', b'') or b''  # websocket-client 1.2 has none
            raise refusal(error.status_code, parsed(data), data) from error
        except (websocket.WebSocketException, OSError) as error:
            raise self._unreachable(error) from error

    def websocket(self, path: str, query: Query, *, timeout: float) -> websocket.WebSocket:
        """
        Open a WebSocket to a pod's ``exec``.

        :param timeout: time-out in seconds.
        :raises ApiError: the API server refused, or there is no such pod.
        :raises Unreachable: the API server does not answer.
        """
        client = self._client
        try:
            return self._websocket(path, query, timeout)
        except ApiError as error:
            if error.status != 401 or not self._renewed(client):
                raise
            return self._websocket(path, query, timeout)


def existing(
    api: Api, path: str, cancel: Optional[threading.Event] = None,
) -> Optional[dict[str, Any]]:
    """
    Return an object of the cluster, None if there is none.

    :raises ApiError: the API server refused for another reason.
    """
    try:
        return api.request('GET', path, cancel=cancel)
    except ApiError as error:
        if error.status != 404:
            raise
        return None


_apis: dict[tuple[str, str], Api] = {}
_apis_lock = threading.Lock()


def connect(context: str = '') -> Api:
    """
    Return the API server of a context of the kubeconfig; '' is the current context.

    Callers with the same context share one object and its connections.

    :raises PrerequisiteError: no kubeconfig, no such context, or no valid credentials.
    """
    kubeconfig = os.environ.get('KUBECONFIG', '')
    with _apis_lock:
        api = _apis.get((context, kubeconfig)) or Api(context)
        # Also store the current context by its name, so that both share one object.
        return _apis.setdefault(
            (context, kubeconfig), _apis.setdefault((api.context, kubeconfig), api))


def _tls(configuration: Any) -> dict[str, Any]:
    """Return the TLS options of the WebSocket, equal to those of the requests."""
    import ssl
    options: dict[str, Any] = {'cert_reqs': ssl.CERT_NONE, 'check_hostname': False}
    if configuration.verify_ssl:
        options = {'cert_reqs': ssl.CERT_REQUIRED}
        if configuration.ssl_ca_cert:
            options['ca_certs'] = configuration.ssl_ca_cert
        if configuration.assert_hostname is not None:
            options['check_hostname'] = bool(configuration.assert_hostname)
    for name, key in (('cert_file', 'certfile'), ('key_file', 'keyfile'),
                      ('tls_server_name', 'server_hostname')):
        if value := getattr(configuration, name, None):
            options[key] = value
    return options
