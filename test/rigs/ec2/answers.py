# SPDX-License-Identifier: Apache-2.0
"""Answers and refusals in the forms of AWS's protocols: query (EC2) and JSON (SSM, prices)."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import json
from typing import Any
import uuid
from xml.sax.saxutils import escape

_EC2 = 'http://ec2.amazonaws.com/doc/2016-11-15/'
#: HTTP status of error codes; others have 400.
_STATUS = {
    'RequestLimitExceeded': 503, 'Throttling': 400, 'ThrottlingException': 400,
    'Unavailable': 503, 'ServiceUnavailable': 503, 'InternalError': 500,
    'InternalFailure': 500, 'UnauthorizedOperation': 403, 'AccessDenied': 403,
    'AccessDeniedException': 400, 'AuthFailure': 401, 'InsufficientInstanceCapacity': 500,
    'ExpiredToken': 400, 'ExpiredTokenException': 400, 'InsufficientHostCapacity': 500,
}
#: What AWS says with a code.
_MESSAGES = {
    'InsufficientInstanceCapacity':
        'We currently do not have sufficient capacity in the Availability Zone you requested. '
        'Our system will be working on provisioning additional capacity.',
    'VcpuLimitExceeded':
        'You have requested more vCPU capacity than your current vCPU limit of 0 allows for the '
        'instance bucket that the specified instance type belongs to.',
    'RequestLimitExceeded': 'Request limit exceeded.',
    'UnauthorizedOperation': 'You are not authorized to perform this operation.',
    'ExpiredToken': 'The security token included in the request is expired',
    'AuthFailure': 'AWS was not able to validate the provided access credentials',
    'InvalidInstanceID.NotFound': 'The instance ID does not exist',
    'MaxSpotInstanceCountExceeded': 'Max spot instance count exceeded',
    'SpotMaxPriceTooLow': 'Your Spot request price is lower than the minimum required',
    'RequestExpired': 'Request has expired.',
}


@dataclasses.dataclass(frozen=True)
class Answer:
    """What goes back to the caller."""

    status: int
    content_type: str
    body: bytes


class Refusal(Exception):
    """An error that AWS would answer; ``code`` is AWS's."""

    def __init__(self, code: str, message: str = '') -> None:
        super().__init__(message or _MESSAGES.get(code, code))
        self.code = code


def refusal(service: str, code: str, message: str = '') -> Answer:
    """Return an error in the form of a service's protocol."""
    status = _STATUS.get(code, 400)
    text = message or _MESSAGES.get(code, code)
    if service in ('ssm', 'pricing'):
        return Answer(status, 'application/x-amz-json-1.1',
                      json.dumps({'__type': code, 'message': text}).encode())
    inner = f'<Code>{escape(code)}</Code><Message>{escape(text)}</Message>'
    if service == 'ec2':
        body = (f'<Response><Errors><Error>{inner}</Error></Errors>'
                f'<RequestID>{uuid.uuid4()}</RequestID></Response>')
    else:
        body = (f'<ErrorResponse><Error><Type>Sender</Type>{inner}</Error>'
                f'<RequestId>{uuid.uuid4()}</RequestId></ErrorResponse>')
    return Answer(status, 'text/xml;charset=UTF-8', body.encode())


def of_json(data: Mapping[str, Any]) -> Answer:
    """Return an answer of a JSON service."""
    return Answer(200, 'application/x-amz-json-1.1', json.dumps(data).encode())


def of_ec2(action: str, inner: str) -> Answer:
    """Return an answer of EC2's; ``inner`` is XML."""
    return Answer(200, 'text/xml;charset=UTF-8', (
        f'<?xml version="1.0" encoding="UTF-8"?><{action}Response xmlns="{_EC2}">'
        f'<requestId>{uuid.uuid4()}</requestId>{inner}</{action}Response>').encode())
