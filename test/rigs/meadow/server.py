# SPDX-License-Identifier: Apache-2.0
"""
The service: machines in memory, over HTTP on the loopback, without any real machine.

It refuses what a real service refuses: a wrong token, a label with other characters than
``a-z0-9_-`` or with more than 63, a type or a zone that it does not have. A new machine is
pending for one report; a deleted one is reported once more; a full zone refuses.
"""

from __future__ import annotations

from collections.abc import Mapping
import http.server
import itertools
import json
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
ZONES = {'north': ['north-a', 'north-b'], 'south': ['south-a']}


class Refusal(Exception):
    """An answer with an error."""

    def __init__(self, status: int, code: str) -> None:
        super().__init__(code)
        self.status = status
        self.code = code


class Meadow:
    """The state of the service; ``full`` are zones without capacity."""

    def __init__(self) -> None:
        self.machines: dict[str, dict[str, Any]] = {}
        self.full: set[str] = set()
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)

    def answer(self, method: str, path: str, query: Mapping[str, str], body: Any) -> Any:
        """Return the answer to a request; the paths are those of ``provider``."""
        with self._lock:
            if path == '/account':
                return {'name': 'robots'}
            found = re.fullmatch(r'/regions/(\w+)/(types|machines)(?:/([\w-]+))?(?:/(\w+))?', path)
            if found is None or found[1] not in ZONES:
                raise Refusal(404, 'no_such_path')
            region, kind, identity, action = found.groups()
            if kind == 'types':
                return TYPES
            if identity is None:
                return self._create(region, body) if method == 'POST' else [
                    machine for machine in self.machines.values()
                    if machine['region'] == region and query.items() <= machine['labels'].items()]
            return self._change(method, region, identity, action, body)

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
            machine['state'], machine['reports'] = 'deleting', 1
        elif action == 'stop':
            machine['state'] = 'stopped'
        elif action == 'start':
            machine['state'], machine['reports'] = 'pending', 1
        elif action == 'labels':
            self._check_labels(body)
            machine['labels'] = {**machine['labels'], **body}
        elif action == 'firewall':
            machine['firewall'] = {**machine['firewall'], **body}
        elif method == 'GET':
            self._report(machine)
        return dict(machine)

    def _report(self, machine: dict[str, Any]) -> None:
        machine['reports'] -= 1
        if machine['state'] == 'pending' and machine['reports'] < 0:
            machine['state'] = 'running'
        if machine['state'] == 'deleting' and machine['reports'] < 0:
            del self.machines[machine['id']]
            raise Refusal(404, 'no_such_machine')

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
            try:
                if self.headers.get('Authorization') != f'Bearer {TOKEN}':
                    raise Refusal(401, 'bad_token')
                status, answer = 200, meadow.answer(
                    self.command, parts.path, dict(parse_qsl(parts.query)), body)
            except Refusal as error:
                status, answer = error.status, {'code': error.code}
            data = json.dumps(answer).encode()
            self.send_response(status)
            self.send_header('Content-Length', str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        do_GET = do_POST = do_PUT = do_DELETE = _answer

        def log_message(self, *args: object) -> None:
            """Write no log."""

    return http.server.ThreadingHTTPServer(('127.0.0.1', 0), Handler)
