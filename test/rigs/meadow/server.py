# SPDX-License-Identifier: Apache-2.0
"""
The service: machines in memory, over HTTP on the loopback, without any real machine.

It refuses what a real service refuses: a wrong token, a label with other characters than
``a-z0-9_-`` or with more than 63, a type or a zone that it does not have. A new machine is
pending for one report; a deleted one stays for ``DELETION`` seconds.
``fault`` disturbs the next requests for a machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import itertools
import json
import math
import re
import threading
import time
from typing import Any
from urllib.parse import parse_qsl

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


#: Answers to a request for a machine, by the fault; one that is 'lost' has its effect.
FAULTS: Mapping[str, tuple[int, str, Mapping[str, str]]] = {
    'throttled': (429, 'too_fast', {'Retry-After': '1'}), 'unavailable': (503, 'closed', {}),
    'full': (409, 'exhausted', {}), 'lost': (500, 'no_answer', {})}


class Meadow:
    """
    The service, a WSGI application.

    :ivar orders: when each request for a machine came, by the monotonic clock.
    """

    def __init__(self) -> None:
        self.machines: dict[str, dict[str, Any]] = {}
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

    def __call__(self, environ: Mapping[str, Any], start_response: Any) -> list[bytes]:
        """Answer a request, not while the service is silent."""
        text = environ['wsgi.input'].read(int(environ.get('CONTENT_LENGTH') or 0))
        if not self._answering.is_set():
            self._met.set()
            self._answering.wait(30.0)
        headers: Mapping[str, str] = {}
        try:
            if environ.get('HTTP_AUTHORIZATION') != f'Bearer {TOKEN}':
                raise Refusal(401, 'bad_token')
            status, answer = 200, self.answer(
                environ['REQUEST_METHOD'], environ['PATH_INFO'],
                dict(parse_qsl(environ['QUERY_STRING'])), json.loads(text) if text else None)
        except Refusal as error:
            status, answer, headers = error.status, {'code': error.code}, error.headers
        data = json.dumps(answer).encode()
        start_response(f'{status} {status}', [
            *headers.items(), ('Content-Length', str(len(data)))])
        return [data]

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
            if fault == 'lost':
                self._create(region, body)
            status, code, headers = FAULTS[fault]
            raise Refusal(status, code, **headers)
        return self._create(region, body)

    def _create(self, region: str, body: dict[str, Any]) -> dict[str, Any]:
        for machine in self.machines.values():
            if machine['key'] == body['key']:
                return machine
        if body['type'] not in [kind['name'] for kind in TYPES] \
                or body['zone'] not in ZONES[region]:
            raise Refusal(400, 'bad_request')
        self._check_labels(body['labels'])
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
