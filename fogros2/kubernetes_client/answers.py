# SPDX-License-Identifier: Apache-2.0
"""Parse the responses of an API server: errors and lists; build paths and selectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
from typing import Any

from fogros2.errors import ProviderError


class ApiError(ProviderError):
    """
    The API server refused a request.

    :param status: HTTP status: 403, 404, 409, 422, ...
    :param reason: the API's reason: Forbidden, NotFound, AlreadyExists, Invalid, ...
    """

    def __init__(
        self, message: str, hint: str = '', *, status: int = 0, reason: str = '',
    ) -> None:
        super().__init__(message, hint)
        self.status = status
        self.reason = reason


class Unreachable(ProviderError):
    """The API server does not answer."""


def http_errors() -> tuple[type[BaseException], ...]:
    """Return the types of errors that a broken connection may raise."""
    import urllib3
    return (urllib3.exceptions.HTTPError, OSError)


def parsed(data: bytes) -> dict[str, Any]:
    """Parse a response's JSON object; return an empty one if it is invalid."""
    try:
        body = json.loads(data)
    except ValueError:
        return {}
    return body if isinstance(body, dict) else {}


def refusal(status: int, answer: Mapping[str, Any], data: bytes) -> ApiError:
    """Return the error for a response with a status of 400 and above."""
    message = str(answer.get('message') or data[:300].decode(errors='replace')
                  or f'HTTP status {status}')
    hint = 'the kubeconfig holds credentials that the cluster does not take: log in again' \
        if status == 401 else ''
    return ApiError(' '.join(message.split()), hint, status=status,
                    reason=str(answer.get('reason') or ''))


def selector(labels: Mapping[str, str]) -> str:
    """Return labels as the ``labelSelector`` of a query."""
    return ','.join(f'{key}={value}' if value else key for key, value in labels.items())


def path(kind: str, namespace: str = '', name: str = '', *rest: str) -> str:
    """
    Return the path of objects of a kind; without ``namespace``, in all namespaces.

    >>> path('jobs', 'robots', 'talker')
    '/apis/batch/v1/namespaces/robots/jobs/talker'
    """
    group = '/apis/batch/v1' if kind == 'jobs' else '/api/v1'
    parts = [group, *(['namespaces', namespace] if namespace else []), kind,
             *([name] if name else []), *rest]
    return '/'.join(parts)


def items(answer: Mapping[str, Any]) -> Sequence[dict[str, Any]]:
    """Return the objects of a list."""
    return answer.get('items') or []
