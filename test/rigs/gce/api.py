# SPDX-License-Identifier: Apache-2.0
"""
The API in a box: a WSGI application, with faults to order and a record of calls.

Google's discovery document is the judge of every request and answer: a request that it does not
know is refused, and an answer of the box that it does not know is an error of the box.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Mapping
import dataclasses
import json
import re
import secrets
import sys
from typing import Any, Optional
from urllib.parse import parse_qsl

from rigs.computers import faults
from rigs.computers.box import Call
from rigs.gce import catalogue, discovery
from rigs.gce.cloud import GUEST_TOKEN
from rigs.gce.errors import late, Refusal
from rigs.gce.resources import Project


@dataclasses.dataclass
class Fault:
    """
    An error to order.

    :param code: Google's reason, or in capitals the code of an operation that fails late.
    :param action: such as 'instances.insert'.
    :param times: how often; 0 for always.
    :param after: carry the request out first, as if its answer was lost.
    """

    code: str
    action: str
    times: int = 1
    after: bool = False


class Api:
    """
    The WSGI application.

    :param key: public key of the account whose assertions get a token.
    """

    def __init__(self, project: Project, key: Any) -> None:
        self.project = project
        self._key = key
        self._tokens = {GUEST_TOKEN}
        self.faults: list[Fault] = []
        self.calls: list[Call] = []

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any],
                 ) -> Iterable[bytes]:
        """Answer a request."""
        body = environ['wsgi.input'].read(int(environ.get('CONTENT_LENGTH') or 0))
        if environ['PATH_INFO'] == '/token':
            status, answer = self._token(dict(parse_qsl(body.decode())))
        elif environ['PATH_INFO'] == '/v1/services/6F81-5844-456A/skus':
            status, answer = self._skus(dict(parse_qsl(environ.get('QUERY_STRING', ''))))
        else:
            status, answer = self._answer(environ, body)
        data = json.dumps(answer).encode()
        start_response(f'{status} {status}', [
            ('Content-Type', 'application/json; charset=UTF-8'),
            ('Content-Length', str(len(data)))])
        return [data]

    def _token(self, form: Mapping[str, str]) -> tuple[int, Any]:
        """Give a token for an assertion that the account's key has signed (RFC 7523)."""
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.padding import PKCS1v15
        from cryptography.hazmat.primitives.hashes import SHA256
        signed, _, signature = form.get('assertion', '').rpartition('.')
        try:
            self._key.verify(base64.urlsafe_b64decode(signature + '=='), signed.encode(),
                             PKCS1v15(), SHA256())
        except (InvalidSignature, ValueError):
            return 400, {'error': 'invalid_grant', 'error_description': 'Invalid JWT Signature.'}
        token = f'ya29.{secrets.token_urlsafe(20)}'
        self._tokens.add(token)
        return 200, {'access_token': token, 'expires_in': 3599, 'token_type': 'Bearer'}

    def _skus(self, query: Mapping[str, str]) -> tuple[int, Any]:
        """Answer for the catalogue of prices, which has pages."""
        self.calls.append(Call('cloudbilling', '', 'services.skus.list', ''))
        if query.get('key') != catalogue.API_KEY:
            return 400, {'error': {'code': 400, 'message': 'API key not valid.'}}
        begin, found = int(query.get('pageToken') or 0), catalogue.skus()
        answer = {'skus': found[begin:begin + 5],
                  'nextPageToken': str(begin + 5) if begin + 5 < len(found) else ''}
        discovery.check({'$ref': 'ListSkusResponse'}, answer, 'skus', 'cloudbilling')
        return 200, answer

    def _answer(self, environ: Mapping[str, Any], body: bytes) -> tuple[int, Any]:
        query = dict(parse_qsl(environ.get('QUERY_STRING', '')))
        path = environ['PATH_INFO'].removeprefix(discovery.ROOT)
        found = discovery.route(environ['REQUEST_METHOD'], path)
        name = found.name if found else f'{environ["REQUEST_METHOD"]} {path}'
        code = ''
        try:
            if environ.get('HTTP_AUTHORIZATION', '').removeprefix('Bearer ') not in self._tokens:
                raise Refusal('authError')
            if found is None:
                raise Refusal('notFound', f'there is no {name}')
            answer = self._carry_out(found, query, json.loads(body) if body else None)
            status = 200
        except Refusal as error:
            code, status, answer = error.reason, error.status, error.body()
        except discovery.Mismatch as error:
            code = 'badRequest'
            status, answer = 400, Refusal('badRequest', str(error)).body()
        words = found.words if found else {}
        self.calls.append(Call('compute', words.get('zone', ''), name, code))
        return status, answer

    def _carry_out(self, found: discovery.Route, query: Mapping[str, str], body: Any) -> Any:
        discovery.check_parameters(found, query)
        discovery.check_body(found, body)
        fault = faults.due(self.faults, lambda one: one.action == found.name)
        if fault and not fault.after and not fault.code.isupper():
            raise Refusal(fault.code)
        if found.words['project'] != self.project.name and not found.name.startswith('images.'):
            raise Refusal('notFound', f"The resource 'projects/{found.words['project']}' was not "
                          'found')
        name = re.sub('([A-Z])', lambda one: f'_{one[1].lower()}', found.name.replace('.', '_'))
        handler = getattr(self.project, name, None)
        if handler is None:
            raise Refusal('notImplemented', f'{found.name} is not known in a box')
        waits = found.name.endswith('.wait')
        answer = handler(found.words, query, body) if waits else self._locked(
            handler, found, query, body, fault)
        try:
            discovery.check_answer(found, answer)
        except discovery.Mismatch as error:
            print(f'the answer to {found.name}: {error}', file=sys.stderr, flush=True)
            raise Refusal('internalError', f'the box is wrong: {error}') from error
        if fault and fault.after:
            raise Refusal(fault.code)
        return answer

    def _locked(self, handler: Callable[..., Any], found: discovery.Route,
                query: Mapping[str, str], body: Any, fault: Optional[Fault]) -> Any:
        project = self.project
        with project.lock:
            earlier = project.once(query, found.name, found.words, body)
            if earlier is not None:
                return earlier
            try:
                if fault and fault.code.isupper():
                    answer = self._late(handler, found, query, body, fault)
                else:
                    answer = handler(found.words, query, body)
            except Refusal:
                project.remember(query, '')
                raise
            project.remember(query, answer.get('name', ''))
            # an answer is as of now, and a resource changes
            return json.loads(json.dumps(answer))

    def _late(self, handler: Callable[..., Any], found: discovery.Route,
              query: Mapping[str, str], body: Any, fault: Fault) -> Any:
        """Let an operation fail after Google has accepted it."""
        if found.name == 'instances.insert':
            return self.project.instances_insert(found.words, query, body, late(fault.code))
        operation = handler(found.words, query, body)
        self.project.operations[operation['name']].error = late(fault.code)
        return operation
