# SPDX-License-Identifier: Apache-2.0
"""
How long a call to AWS may take: again where that helps, and no longer than a launch wants it.

boto3 repeats throttled calls by itself, with pauses of up to 20 s that nothing ends. So who makes
a call for a launch waits for it beside the launch's cancel, and what is left of it sends nothing.
"""

from __future__ import annotations

from collections.abc import Callable
import threading
from typing import Any, Optional, TypeVar

from fogros2.errors import Cancelled
from fogros2.provider.aws.failures import NO_ROOM
from fogros2.waiting import cancellable

T = TypeVar('T')

#: AWS took a request for one too many, and did nothing.
THROTTLED = frozenset({
    'RequestLimitExceeded', 'Throttling', 'ThrottlingException', 'RequestThrottled',
    'EC2ThrottledException', 'TooManyRequestsException'})
#: Attempts of a call to which no answer comes at all.
UNANSWERED = 2
#: Seconds that a request on its way gets to be answered: it may be making something.
ON_ITS_WAY = 4.0
_here = threading.local()


class _Call:
    """A call under way, from the side of its thread."""

    def __init__(self, cancel: threading.Event) -> None:
        self.cancel = cancel
        #: Whether a request is on its way now, and whether one may have done what it asks for.
        self.sent = self.unsure = False


def unless(cancel: Optional[threading.Event], work: Callable[[], T], what: str) -> T:
    """
    Return what ``work`` returns, in a thread of its own that is left alone once ``cancel`` is set.

    A request that is on its way at that moment is waited for a little, and its answer returned:
    it may have made something.

    :param cancel: None to wait for the work, however long it takes.
    :raises Cancelled: ``cancel`` was set first; ``refused`` is set where AWS has done nothing.
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
    """Have a boto3 client obey its caller's cancel, and not ask in vain."""
    service = client.meta.service_model.service_id.hyphenize()
    # last: what limits the rate waits in such a handler as well
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
    Keep botocore from asking again where that doesn't help; called before its own decision.

    Throttling takes patience; but without a way to AWS a user would wait for minutes to hear of
    it. And EC2 says with status 500, which botocore takes for a fault that passes in a moment,
    that it has no machine left: the next zone may have.
    """
    call: Optional[_Call] = getattr(_here, 'call', None)
    http = response[0] if response else None
    code = response[1].get('Error', {}).get('Code', '') if response else ''
    if call is not None and call.sent:
        call.sent = False
        fault = http is None or http.status_code >= 500
        call.unsure = call.unsure or fault and code not in NO_ROOM | THROTTLED
    if caught_exception is not None and (
            attempts >= UNANSWERED or call is not None and call.cancel.is_set()):
        raise caught_exception
    if http is not None and http.status_code >= 500 and code in NO_ROOM:
        http.status_code = 400
