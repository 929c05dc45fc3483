# SPDX-License-Identifier: Apache-2.0
"""Requests to a test's cluster, made without the client that the product uses."""

from __future__ import annotations

import base64
import json
from pathlib import Path
import ssl
from typing import Any, Optional
import urllib.error
import urllib.parse
import urllib.request


class Refused(AssertionError):
    """The API server refused a request; ``status`` is HTTP's."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(f'{status}: {message}')
        self.status = status


class Client:
    """
    The API server, as one user sees it.

    :param kubeconfig: one that ``Cluster`` wrote.
    """

    def __init__(self, kubeconfig: Path) -> None:
        config = json.loads(kubeconfig.read_text())
        self._server = str(config['clusters'][0]['cluster']['server'])
        authority = config['clusters'][0]['cluster']['certificate-authority-data']
        self._tls = ssl.create_default_context(cadata=base64.b64decode(authority).decode())
        self._token = str(config['users'][0]['user']['token'])

    def ask(
        self, method: str, path: str, body: Optional[dict[str, Any]] = None, **query: str,
    ) -> dict[str, Any]:
        """
        Make a request and return the answer.

        :raises Refused: it isn't a success.
        """
        kind = 'application/merge-patch+json' if method == 'PATCH' else 'application/json'
        request = urllib.request.Request(
            f'{self._server}{path}?{urllib.parse.urlencode(query)}', method=method,
            data=None if body is None else json.dumps(body).encode(),
            headers={'Authorization': f'Bearer {self._token}', 'Content-Type': kind})
        try:
            with urllib.request.urlopen(request, timeout=30, context=self._tls) as answer:
                found: dict[str, Any] = json.loads(answer.read())
        except urllib.error.HTTPError as error:
            raise Refused(error.code, error.read().decode()) from error
        return found

    def create(self, path: str, kind: str, name: str, **fields: Any) -> dict[str, Any]:
        """
        Create an object.

        :param kind: with its API version, as in ``batch/v1 Job``.
        """
        version, _, word = kind.rpartition(' ')
        metadata = {'name': name, **fields.pop('metadata', {})}
        return self.ask('POST', path, {
            'apiVersion': version, 'kind': word, 'metadata': metadata, **fields})
