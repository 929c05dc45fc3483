# SPDX-License-Identifier: Apache-2.0
"""Google's refusals: at once with a reason, or late, as the error of an operation."""

from __future__ import annotations

from typing import Any

#: HTTP status of reasons; others have 400.
STATUS = {
    'notFound': 404, 'alreadyExists': 409, 'forbidden': 403, 'rateLimitExceeded': 403,
    'conditionNotMet': 412, 'authError': 401, 'backendError': 503, 'internalError': 500}
class Refusal(Exception):
    """An error that Google answers at once; ``reason`` is Google's."""

    def __init__(self, reason: str, message: str = '') -> None:
        super().__init__(message or reason)
        self.reason = reason
        self.status = STATUS.get(reason, 400)

    def body(self) -> dict[str, Any]:
        """Return the answer."""
        return {'error': {'code': self.status, 'message': str(self), 'errors': [
            {'domain': 'global', 'reason': self.reason, 'message': str(self)}]}}


def late(code: str) -> dict[str, Any]:
    """Return the error of an operation."""
    return {'errors': [{'code': code, 'message': code}]}
