# SPDX-License-Identifier: Apache-2.0
"""
A cluster's API server, as the kubeconfig describes it: requests, watches, exec's WebSocket.

The official client reads the kubeconfig, gets and renews the credentials and sets TLS up. Requests
are made by path and answered in JSON: its classes for every kind of object take most of a second
to load, and none of them is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
import json
import os
import threading
import time
from typing import Any, Optional, TYPE_CHECKING, TypeVar
from urllib.parse import urlencode

from fogros2.errors import DeadlineExceeded, ProviderError
from fogros2.kubernetes_client import configuration as kubeconfig
from fogros2.kubernetes_client.answers import (
    ApiError,
    http_errors,
    parsed,
    refusal,
    Unreachable,
)
from fogros2.kubernetes_client.configuration import words
from fogros2.kubernetes_client.watch import Watch
from fogros2.waiting import cancellable, wait_until

if TYPE_CHECKING:
    import websocket

T = TypeVar('T')
#: Query parameters; a list repeats the name.
Query = Mapping[str, Any]

#: Seconds in which a connection to the API server has to stand.
CONNECT = 5.0
#: Seconds that one request may take.
ANSWER = 30.0
#: Seconds for which an API server that restarts is waited for.
PATIENCE = 30.0
#: Seconds after a restart in which an API server may not know yet what it allows whom.
DOUBT = 15.0


class Api:
    """
    The API server of one context; thread-safe.

    :param context: name of a context of the kubeconfig; '' for the current one.
    :raises PrerequisiteError: no kubeconfig, no such context, or its credentials can't be had.
    """

    def __init__(self, context: str = '') -> None:
        self.context, self.namespace, self._client = kubeconfig.load(context)
        #: Requests made so far, for the figures.
        self.calls = 0
        self._lost = -DOUBT

    @property
    def server(self) -> str:
        """The API server's address."""
        return str(self._client.configuration.host)

    def headers(self) -> dict[str, str]:
        """Return what authenticates a request; renews what has run out."""
        found: dict[str, str] = {}
        for each in self._client.configuration.auth_settings().values():
            if each['in'] == 'header' and each['value']:
                found[each['key']] = each['value']
        return found

    # -- requests -------------------------------------------------------------------------------

    def request(
        self, method: str, path: str, body: Optional[Mapping[str, Any]] = None,
        *, patience: float = PATIENCE, doubt: float = 0.0,
        cancel: Optional[threading.Event] = None, **query: Any,
    ) -> dict[str, Any]:
        """
        Make a request and return the answer.

        :param patience: seconds for which an API server that doesn't answer is asked again.
        :param doubt: seconds for which one that says that we may not is.
        :raises ApiError: it refused.
        :raises Unreachable: it doesn't answer.
        :raises Cancelled: ``cancel`` was set, and no answer came soon after.
        """
        last: list[ProviderError] = []
        sure = time.monotonic() + doubt
        answer = min(ANSWER, max(CONNECT, patience))

        def attempt() -> Optional[dict[str, Any]]:
            try:
                return cancellable(lambda: self._once(method, path, body, query, answer), cancel,
                                   what=f'asking the API server {self.server}')
            except Unreachable as error:
                last[:] = [error]
            except ApiError as error:
                if not self.passing(error) and not (
                        error.status == 403 and time.monotonic() < sure):
                    raise
                last[:] = [error]
            return None

        try:
            return wait_until(attempt, timeout=patience, cancel=cancel, interval=0.1,
                              what=f'the API server {self.server}')
        except DeadlineExceeded as error:
            raise last[0] from error

    def passing(self, error: ApiError) -> bool:
        """Return whether a refusal may be one of an API server that has just begun again."""
        return error.status in (429, 500, 502, 503, 504) or (
            error.status == 403 and time.monotonic() - self._lost < DOUBT)

    def lost(self) -> None:
        """Note that a connection to the API server was lost, or none can be had."""
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
        found = parsed(data)
        if response.status >= 400:
            raise refusal(response.status, found, data)
        return found

    def send(
        self, method: str, path: str, body: Optional[Mapping[str, Any]], query: Query,
        read: Optional[float],
    ) -> Any:
        """
        Make a request, and return urllib3's response with its body unread.

        :param read: seconds of silence that are borne, None for any.
        :raises Unreachable: no answer began.
        """
        import urllib3

        headers = {'accept': 'application/json', **self.headers()}
        if body is not None:
            headers['content-type'] = 'application/merge-patch+json' \
                if method == 'PATCH' else 'application/json'
        self.calls += 1
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

        :param look: gets ADDED, MODIFIED or DELETED and the object; what is there already comes
            as ADDED, unless ``resourceVersion`` says where to begin.
        :param again: asked first when a watch was lost and is begun anew, from what is there then.
        :param tick: asked a few times a second, for what has a deadline of its own.
        :raises DeadlineExceeded: after ``timeout`` seconds.
        :raises Cancelled: ``cancel`` was set.
        """
        with contextlib.ExitStack() as undo:
            watch: Optional[Watch] = None
            lost = False

            def probe() -> Optional[tuple[T]]:
                nonlocal watch, lost, query
                if watch is None:
                    if lost and again is not None and (found := again()) is not None:
                        return (found,)
                    watch = undo.enter_context(Watch(self, path, {'watch': 'true', **query}))
                event = watch.get(0.1)
                if event is not None and event[0] in ('CLOSED', 'ERROR'):
                    watch.__exit__()
                    watch, lost = None, True
                    query = {k: v for k, v in query.items() if k != 'resourceVersion'}
                elif event is not None and event[0] != 'BOOKMARK':
                    found = look(*event)
                    return None if found is None else (found,)
                found = tick() if tick is not None else None
                return None if found is None else (found,)

            return wait_until(probe, timeout=timeout, what=what, cancel=cancel,
                              interval=0.0)[0]

    # -- exec -----------------------------------------------------------------------------------

    def websocket(self, path: str, query: Query, *, timeout: float) -> websocket.WebSocket:
        """
        Open a WebSocket for a pod's ``exec``.

        :raises ApiError: refused, or no such pod.
        :raises Unreachable: the API server doesn't answer.
        """
        import websocket

        self.calls += 1
        options: dict[str, Any] = {}
        configuration = self._client.configuration
        if proxy := configuration.proxy:
            from urllib.parse import urlsplit
            found = urlsplit(proxy)
            options.update(http_proxy_host=found.hostname, http_proxy_port=found.port,
                           proxy_type='http')
            if found.username:
                options['http_proxy_auth'] = (found.username, found.password or '')
        url = self._url(path, query).replace('http', 'ws', 1)
        try:
            return websocket.create_connection(
                url, timeout=timeout, sslopt=_tls(configuration), enable_multithread=False,
                header=[f'{name}: {value}' for name, value in self.headers().items()],
                subprotocols=['v4.channel.k8s.io'], skip_utf8_validation=True, **options)
        except websocket.WebSocketBadStatusException as error:
            data = error.resp_body or b''
            raise refusal(error.status_code, parsed(data), data) from error
        except (websocket.WebSocketException, OSError) as error:
            raise self._unreachable(error) from error


    def execute(
        self, path: str, container: str, command: Sequence[str], *, timeout: float,
    ) -> None:
        """
        Run a command in a pod, and wait for its first word or its end, so many seconds at most.

        :raises ApiError: refused, or no such pod.
        :raises Unreachable: the API server doesn't answer.
        """
        import websocket

        link = self.websocket(path, {
            'container': container, 'command': list(command), 'stdout': 'true',
            'stderr': 'true'}, timeout=timeout)
        with contextlib.suppress(websocket.WebSocketException, OSError):
            link.recv()
        link.close(timeout=0)


_apis: dict[tuple[str, str], Api] = {}
_apis_lock = threading.Lock()


def connect(context: str = '') -> Api:
    """
    Return the API server of a context of the kubeconfig, '' for the current one.

    All who name the same one share its connections.

    :raises PrerequisiteError: no kubeconfig, no such context, or its credentials can't be had.
    """
    kubeconfig = os.environ.get('KUBECONFIG', '')
    with _apis_lock:
        found = _apis.get((context, kubeconfig))
        if found is None:
            found = Api(context)
            # by its name as well, if it was asked for as the current one
            found = _apis.setdefault((found.context, kubeconfig), found)
            _apis[context, kubeconfig] = found
        return found


def _tls(configuration: Any) -> dict[str, Any]:
    """Return how the WebSocket checks the API server, the same way as the requests."""
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
