# SPDX-License-Identifier: Apache-2.0
"""Errors of clouds that give a code: a class for each cloud, with a table from codes to hints."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
import time
from typing import Any, ClassVar, Literal, NamedTuple, NoReturn, Optional, TypeVar

from fogros2.errors import DeadlineExceeded, FogError, PrerequisiteError, ProviderError
from fogros2.provider.vm.cloud import CloudError
from fogros2.waiting import wait_until

T = TypeVar('T')

#: Maximum length of a cloud's own text in a message.
LENGTH = 300
#: Seconds for which a cloud may not know everywhere what it has just created.
SETTLING = 60.0


class Failure(NamedTuple):
    """
    The meaning of a code.

    :param reason: '' keeps the cloud's own words.
    :param kind: of the error; only a CodedError has what follows: see :class:`CloudError`.
    :param temporary: the cloud did nothing, and the same request may succeed later.
    """

    reason: str = ''
    hint: str = ''
    kind: type[FogError] = ProviderError
    full: Literal['', 'zone', 'region'] = ''
    gone: bool = False
    denied: bool = False
    temporary: bool = False


class CodedError(CloudError):
    """
    A cloud refused with ``code``; a cloud's subclass has the table.

    :ivar temporary: the cloud did nothing, or has a fault, and the same request may succeed.
    :ivar pause: seconds after which the cloud asks for the next attempt, if it says so.
    """

    TITLE: ClassVar[str]
    FAILURES: ClassVar[Mapping[str, Failure]]

    def __init__(
        self, message: str, hint: str = '', *, code: str = '', status: int = 400,
    ) -> None:
        entry = self.known(code)
        super().__init__(message, hint, full=entry.full, gone=entry.gone, denied=entry.denied)
        self.code = code
        fault = status >= 500 and not self.full and not entry.temporary
        self.temporary = fault or status == 429 or entry.temporary
        # after a fault of the cloud, the request may have had its effect
        self.refused = not fault
        self.pause: Optional[float] = None

    @classmethod
    def known(cls, code: str) -> Failure:
        """Return the meaning of a code, an empty one for an unknown code."""
        return cls.FAILURES.get(code, Failure())

    @classmethod
    def of(cls, code: str, words: str, what: str, status: int = 400) -> FogError:
        """
        Return the error for a code.

        :param words: the cloud's message, in one line.
        :param what: see :meth:`~fogros2.provider.vm.account.Account.repeated`.
        """
        entry = cls.known(code)
        reason = entry.reason or words or code or f'{cls.TITLE} gave no reason'
        message = f'{what} failed: {reason}' + f' [{code}]' * bool(code and code not in reason)
        if entry.kind is ProviderError:
            return cls(message, entry.hint, code=code, status=status)
        error = entry.kind(message, entry.hint)
        error.refused = status < 500
        return error


@contextlib.contextmanager
def unless_gone() -> Iterator[None]:
    """Ignore in the block that a resource does not exist (any more)."""
    try:
        yield
    except CloudError as error:
        if not error.gone:
            raise


@contextlib.contextmanager
def tolerated(*codes: str) -> Iterator[None]:
    """Ignore these codes of a refusal in the block."""
    try:
        yield
    except CodedError as error:
        if error.code not in codes:
            raise


class Silent(PrerequisiteError):
    """
    A request got no answer.

    :param hint: for all reasons but a certificate.
    :param unsent: it did not leave this computer.
    """

    pause: Optional[float] = None

    def __init__(self, message: str, hint: str, *, unsent: bool) -> None:
        super().__init__(message, hint if 'CERTIFICATE_VERIFY_FAILED' not in message else (
            "is this computer's clock right? For a proxy's certificates, set REQUESTS_CA_BUNDLE, "
            'and for AWS AWS_CA_BUNDLE'))
        self.refused = self.unsent = unsent


def settled(request: Callable[[], T], *codes: str, what: str) -> T:
    """
    Make a request about something new, again while the cloud does not know it everywhere.

    :param request: raises Cancelled itself: it alone knows whether something was sent.
    :param codes: of the refusals that say so.
    :param what: see :func:`~fogros2.waiting.wait_until`.
    :raises CodedError: it still does not know it after ``SETTLING`` seconds.
    """
    end = time.monotonic() + SETTLING

    def attempt() -> Optional[tuple[T]]:
        try:
            return (request(),)
        except CodedError as error:
            if error.code not in codes or time.monotonic() >= end:
                raise
            return None

    return wait_until(
        attempt, timeout=2 * SETTLING, interval=0.5, longest=4.0, what=what)[0]


def wait_through(probe: Callable[[], Optional[T]], **options: Any) -> T:
    """
    Wait as :func:`~fogros2.waiting.wait_until` does; a request without an answer ends no wait.

    :raises Silent: at the time-out, if the last request got no answer.
    """
    silent: Optional[Silent] = None

    def look() -> Optional[T]:
        nonlocal silent
        try:
            value = probe()
        except Silent as error:
            silent = error
            return None
        silent = None
        return value

    try:
        return wait_until(look, **options)
    except DeadlineExceeded:
        if silent is not None:
            raise silent from None
        raise


def one_line(text: object) -> str:
    """Return the beginning of a text, such as an error's, in one line."""
    return ' '.join(str(text).split())[:LENGTH]


def not_the_cloud(title: str, what: str, status: int = 0) -> FogError:
    """
    Return the error for an answer that a cloud does not give.

    :param status: of HTTP; 0 if it is unknown.
    """
    detail = f' (HTTP {status})' if status else ''
    error = PrerequisiteError(f'{what} failed: what answered is not {title}{detail}',
                              'is there a proxy, or a page to log in to this network?')
    error.refused = status >= 300  # a damaged answer to a successful request looks the same
    return error


class Fields(dict[str, Any]):
    """
    The fields of a cloud's answer.

    :raises PrerequisiteError: a field that is looked up is missing, so the answer is damaged.
    """

    def __init__(self, answer: Mapping[str, Any], title: str, what: str) -> None:
        super().__init__(answer)
        self._title, self._what = title, what

    def __missing__(self, field: str) -> NoReturn:
        raise not_the_cloud(self._title, self._what)
