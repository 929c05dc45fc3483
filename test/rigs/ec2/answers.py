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
_STATUS = {'AuthFailure': 401}
@dataclasses.dataclass(frozen=True)
class Answer:
    """What goes back to the caller."""

    status: int
    content_type: str
    body: bytes


class Refusal(Exception):
    """An error that AWS would answer; ``code`` is AWS's."""

    def __init__(self, code: str, message: str = '') -> None:
        super().__init__(message or code)
        self.code = code


def refusal(service: str, code: str, text: str = '') -> Answer:
    """Return an error in the form of a service's protocol."""
    status = _STATUS.get(code, 400)
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
