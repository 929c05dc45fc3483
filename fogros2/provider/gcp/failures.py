# SPDX-License-Identifier: Apache-2.0
"""
Convert Google's refusals to FogErrors: one table from error codes to hints.

A request is refused with a *reason* in camel case, and an operation that fails later with a
*code* in capitals. Source: "Troubleshooting errors" of Compute Engine's documentation.
"""

from __future__ import annotations

from collections.abc import Mapping
import re
from typing import Any

from fogros2.errors import FogError, PrerequisiteError
from fogros2.provider.vm.failures import CodedError, Failure, not_the_cloud, one_line

_FAILURES = {
    'AUTH_ERROR': Failure(
        'Google does not take these credentials', 'gcloud auth application-default login',
        PrerequisiteError),
    'ACCESS_NOT_CONFIGURED': Failure(
        'the project has not enabled the Compute Engine API',
        'gcloud services enable compute.googleapis.com', PrerequisiteError),
    'PROJECT_NOT_FOUND': Failure('', 'check project_id=', PrerequisiteError),
    **dict.fromkeys(('ZONE_RESOURCE_POOL_EXHAUSTED', 'ZONE_RESOURCE_POOL_EXHAUSTED_WITH_DETAILS',
                     'STOCKOUT', 'RESOURCE_POOL_EXHAUSTED', 'UNSUPPORTED_OPERATION'), Failure(
        'Google has no free machine of this type here at the moment',
        'try later, or give more types and places: machine_types=, regions=', full='zone')),
    **dict.fromkeys(('QUOTA_EXCEEDED', 'LIMIT_EXCEEDED'), Failure(
        '', 'ask for more at IAM & Admin, Quotas, or take another type or region',
        full='region')),
    'NO_ACCELERATOR': Failure(
        '', 'gcloud compute accelerator-types list shows the zones that have it', full='zone'),
    'NO_NETWORK': Failure('', 'name a network of the project: network='),
    'POLICY': Failure('', 'ask who has assigned the policy', denied=True),
    'RATE_LIMIT_EXCEEDED': Failure(
        'Google asks for fewer requests', 'try again in a minute', temporary=True),
    **dict.fromkeys(('USER_RATE_LIMIT_EXCEEDED', 'RESOURCE_NOT_READY'), Failure(temporary=True)),
    **dict.fromkeys(('FORBIDDEN', 'PERMISSIONS_ERROR'), Failure(
        '', 'give it the roles of doc/gcp.md', denied=True)),
    **dict.fromkeys(('NOT_FOUND', 'RESOURCE_NOT_FOUND'), Failure(gone=True)),
    'RESOURCE_IN_USE_BY_ANOTHER_RESOURCE': Failure('', 'ros2 fog delete again in a minute'),
    'BACKEND_ERROR': Failure('', 'try again; https://status.cloud.google.com has what is known'),
}
#: Codes for refusals whose reason says little, by patterns of their messages.
_KINDS = {'acceleratorType.*not (be )?found': 'NO_ACCELERATOR',
          "/global/networks/[^']*' was not found": 'NO_NETWORK', r'\bconstraints/': 'POLICY'}


class GoogleError(CodedError):
    """Google refused; ``code`` is its error code, in capitals."""

    TITLE = 'Google'
    FAILURES = _FAILURES


def refused(status: int, answer: Any, what: str) -> FogError:
    """
    Return the error for a refused request.

    :param answer: the answer, decoded from JSON; a page from a proxy, or of a fault at Google.
    """
    try:
        error = answer['error']
        details: Mapping[str, Any] = (error.get('errors') or [{}])[0]
        message = str(error.get('message') or '')
        code = re.sub('([a-z])([A-Z])', r'\1_\2', str(details.get('reason') or '')).upper()
    except (TypeError, KeyError, AttributeError, IndexError):
        if status < 500:
            return not_the_cloud('Google', what, status)
        error, message, code = {}, f'Google answered with status {status}', ''
    if status == 401:
        code = 'AUTH_ERROR'
    elif kinds := [kind for pattern, kind in _KINDS.items() if re.search(pattern, message)]:
        code = kinds[0]
    elif status == 404 and re.search(r"resource 'projects/[^/']+'", message):
        code = 'PROJECT_NOT_FOUND'
    elif status in (404, 429):
        code = 'NOT_FOUND' if status == 404 else 'RATE_LIMIT_EXCEEDED'
    return GoogleError.of(
        code or str(error.get('status') or status), one_line(message), what, status)


def failed(operation: Mapping[str, Any], what: str) -> FogError:
    """Return the error for an operation that ended with one."""
    first = operation['error']['errors'][0]
    return GoogleError.of(str(first.get('code', '')), one_line(first.get('message') or ''), what)
