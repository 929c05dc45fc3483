# SPDX-License-Identifier: Apache-2.0
"""
The service: machines in memory, over HTTP on the loopback, without any real machine.

It refuses what a real service refuses: a wrong token, a label with other characters than
``a-z0-9_-`` or with more than 63, a type or a zone that it does not have. A new machine is
pending for one report; a deleted one stays for ``DELETION`` seconds; a full zone refuses.
``fault`` disturbs the next requests for a machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import http.server
import itertools
import json
import math
import re
import threading
import time
from typing import Any
from urllib.parse import parse_qsl, urlsplit

TOKEN = 'meadow-token'
TYPES = [
    {'name': 'small', 'vcpus': 2, 'cores': 1, 'memory_gb': 4.0, 'arch': 'x86_64',
     'price': '0.05'},
    {'name': 'large', 'vcpus': 16, 'cores': 8, 'memory_gb': 64.0, 'arch': 'x86_64',
     'price': '0.80'},
]
#: Seconds for which a machine is being deleted.
DELETION = 0.1
ZONES = {'north': ['north-a', 'north-b'], 'south': ['south-a']}


class Refusal(Exception):
    """An answer with an error."""

    def __init__(self, status: int, code: str, **headers: str) -> None:
        super().__init__(code)
        self.status, self.code, self.headers = status, code, headers


class Lost(Exception):
    """A request that gets no answer."""


#: Answers to a request for a machine that has no effect, by the fault.
REFUSALS: Mapping[str, tuple[int, str, Mapping[str, str]]] = {
    'throttled': (429, 'too_fast', {'Retry-After': '1'}), 'unavailable': (503, 'closed', {}),
    'full': (409, 'exhausted', {})}


class Meadow:
    """
    The state of the service.

    :ivar full: zones without capacity.
    :ivar orders: when each request for a machine came, by the monotonic clock.
    """

    def __init__(self) -> None:
        self.machines: dict[str, dict[str, Any]] = {}
        self.full: set[str] = set()
        self.orders: list[float] = []
        self._faults: list[str] = []
        self._met = threading.Event()
        #: Clear while requests get no answer.
        self._answering = threading.Event()
        self._answering.set()
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)

    @contextlib.contextmanager
    def fault(self, how: str, times: int) -> Iterator[threading.Event]:
        """Let the next requests for a machine fail; see ``fogros2_testing.VmContract``."""
        self._met.clear()
        if how == 'silent':
            self._answering.clear()
        else:
            self._faults = [how] * times
        try:
            yield self._met
        finally:
            self._faults = []
            self._answering.set()

    def wait(self) -> None:
        """Wait while the service is silent."""
        if not self._answering.is_set():
            self._met.set()
            self._answering.wait(30.0)

    def left(self) -> list[str]:
        """Return the machines that exist, those that are being deleted too."""
        with self._lock:
            self._prune()
            return list(self.machines)

    def _prune(self) -> None:
        for machine in [*self.machines.values()]:
            if time.monotonic() > machine.get('gone', math.inf):
                del self.machines[machine['id']]

    def answer(self, method: str, path: str, query: Mapping[str, str], body: Any) -> Any:
        """Return the answer to a request; the paths are those of ``provider``."""
        with self._lock:
            self._prune()
            if path == '/account':
                return {'name': 'robots'}
            found = re.fullmatch(r'/regions/(\w+)/(types|machines)(?:/([\w-]+))?(?:/(\w+))?', path)
            if found is None or found[1] not in ZONES:
                raise Refusal(404, 'no_such_path')
            region, kind, identity, action = found.groups()
            if kind == 'types':
                return {'types': TYPES}
            if identity is None:
                return self._order(region, body) if method == 'POST' else {'machines': [
                    machine for machine in self.machines.values()
                    if machine['region'] == region and query.items() <= machine['labels'].items()]}
            return self._change(method, region, identity, action, body)

    def _order(self, region: str, body: dict[str, Any]) -> dict[str, Any]:
        self.orders.append(time.monotonic())
        fault = self._faults.pop() if self._faults else ''
        if fault:
            self._met.set()
        if fault in REFUSALS:
            status, code, headers = REFUSALS[fault]
            raise Refusal(status, code, **headers)
        machine = self._create(region, body)
        if fault == 'lost':
            raise Lost
        return machine

    def _create(self, region: str, body: dict[str, Any]) -> dict[str, Any]:
        for machine in self.machines.values():
            if machine['key'] == body['key']:
                return machine
        if body['type'] not in [kind['name'] for kind in TYPES] \
                or body['zone'] not in ZONES[region]:
            raise Refusal(400, 'bad_request')
        self._check_labels(body['labels'])
        if body['zone'] in self.full:
            raise Refusal(409, 'exhausted')
        number = next(self._numbers)
        machine = self.machines[f'm-{number:x}'] = {
            **body, 'id': f'm-{number:x}', 'region': region, 'state': 'pending', 'reports': 1,
            'address': f'198.51.100.{number % 250 + 1}', 'created': time.time()}
        return machine

    def _change(
        self, method: str, region: str, identity: str, action: str | None, body: Any,
    ) -> dict[str, Any]:
        machine = self.machines.get(identity)
        if machine is None or machine['region'] != region:
            raise Refusal(404, 'no_such_machine')
        if method == 'DELETE':
            machine['state'] = 'deleting'
            machine.setdefault('gone', time.monotonic() + DELETION)
        elif action == 'stop':
            machine['state'] = 'stopped'
        elif action == 'start':
            machine['state'], machine['reports'] = 'pending', 1
        elif action == 'labels':
            self._check_labels(body)
            machine['labels'] = {**(machine['labels'] if method == 'PATCH' else {}), **body}
        elif action == 'firewall':
            machine['firewall'] = {**machine['firewall'], **body}
        elif method == 'GET':
            self._report(machine)
        return dict(machine)

    def _report(self, machine: dict[str, Any]) -> None:
        machine['reports'] -= 1
        if machine['state'] == 'pending' and machine['reports'] < 0:
            machine['state'] = 'running'

    def _check_labels(self, labels: Mapping[str, str]) -> None:
        if not all(re.fullmatch('[A-Za-z0-9_-]{1,63}', key)
                   and re.fullmatch('[a-z0-9_-]{0,63}', value) for key, value in labels.items()):
            raise Refusal(400, 'bad_label')


def serve(meadow: Meadow) -> http.server.ThreadingHTTPServer:
    """Return a server for the state, which the caller runs and closes."""
    class Handler(http.server.BaseHTTPRequestHandler):
        def _answer(self) -> None:
            parts = urlsplit(self.path)
            length = int(self.headers.get('Content-Length') or 0)
            body = json.loads(self.rfile.read(length)) if length else None
            headers: Mapping[str, str] = {}
            meadow.wait()
            try:
                if self.headers.get('Authorization') != f'Bearer {TOKEN}':
                    raise Refusal(401, 'bad_token')
                status, answer = 200, meadow.answer(
                    self.command, parts.path, dict(parse_qsl(parts.query)), body)
            except Refusal as error:
                status, answer, headers = error.status, {'code': error.code}, error.headers
            except Lost:
                self.close_connection = True
                return
            data = json.dumps(answer).encode()
            self.send_response(status)
            for name, value in {**headers, 'Content-Length': str(len(data))}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)

        do_GET = do_POST = do_PUT = do_PATCH = do_DELETE = _answer

        def log_message(self, *args: object) -> None:
            """Write no log."""

    return http.server.ThreadingHTTPServer(('127.0.0.1', 0), Handler)
