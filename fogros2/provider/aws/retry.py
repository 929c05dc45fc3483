# SPDX-License-Identifier: Apache-2.0
"""
Limit the time of a call to AWS: retry if that helps, and stop when the launch ends.

boto3 retries throttled calls with pauses of up to 20 s that nothing can end. So the call runs in
its own thread, and the caller waits for the call or the cancel. An abandoned call sends no more.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
from typing import Any, Optional, TypeVar

from fogros2.errors import Cancelled
from fogros2.provider.aws.failures import AwsError
from fogros2.waiting import cancellable

T = TypeVar('T')

#: Attempts of a call without any answer.
UNANSWERED = 2
#: Seconds to wait for the answer to a sent request, which may create something.
ON_ITS_WAY = 4.0
_here = threading.local()


class _Call:
    """The state of a call in its thread."""

    def __init__(self, cancel: threading.Event) -> None:
        self.cancel = cancel
        #: Whether a request has no answer yet, and whether one may have had its effect.
        self.sent = self.unsure = False


def unless(cancel: Optional[threading.Event], work: Callable[[], T], what: str) -> T:
    """
    Run ``work`` in its own thread, and abandon it once ``cancel`` is set; return its result.

    A request without an answer gets a few seconds more, because it may have created something.

    :param cancel: None to wait for the end of the work.
    :raises Cancelled: ``cancel`` was set; ``refused`` is True if AWS has done nothing.
    """
    if cancel is None:
        return work()
    call = _Call(cancel)

    def run() -> T:
        _here.call = call
        return work()

    try:
        return cancellable(run, cancel, what=what,
                           grace=lambda: ON_ITS_WAY if call.sent else 0.0)
    except Cancelled as error:
        error.refused = not (call.sent or call.unsure)
        raise


def teach(client: Any) -> None:
    """Let a boto3 client observe its caller's cancel, and retry only if that helps."""
    service = client.meta.service_model.service_id.hyphenize()
    # last: the rate limit also waits in such a handler
    client.meta.events.register_last('before-send', _sending)
    client.meta.events.register_first(f'needs-retry.{service}', _answered)


def _sending(**_: Any) -> None:
    call: Optional[_Call] = getattr(_here, 'call', None)
    if call is not None:
        if call.cancel.is_set():
            raise Cancelled('a request to AWS')
        call.sent = True


def _answered(
    response: Any, attempts: int, caught_exception: Optional[BaseException], **_: Any,
) -> None:
    """
    Keep botocore from useless retries; called before its own decision.

    Without a network, a user would wait for minutes. And EC2 reports missing capacity with status
    500, which botocore treats as a temporary fault; the next zone may have capacity.
    """
    call: Optional[_Call] = getattr(_here, 'call', None)
    http = response[0] if response else None
    code = response[1].get('Error', {}).get('Code', '') if response else ''
    known = AwsError.known(code)
    if call is not None and call.sent:
        call.sent = False
        fault = http is None or http.status_code >= 500
        call.unsure = call.unsure or fault and not known.full and not known.temporary
    if caught_exception is not None and (
            attempts >= UNANSWERED or call is not None and call.cancel.is_set()):
        raise caught_exception
    if http is not None and http.status_code >= 500 and known.full:
        http.status_code = 400
