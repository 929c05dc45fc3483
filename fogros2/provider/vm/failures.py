# SPDX-License-Identifier: Apache-2.0
"""Errors of clouds that give a code: a class for each cloud, with a table from codes to hints."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import ClassVar, NamedTuple, Optional

from fogros2.errors import FogError, PrerequisiteError, ProviderError
from fogros2.provider.vm.cloud import CloudError

#: Maximum length of a cloud's own text in a message.
LENGTH = 300


class Failure(NamedTuple):
    """The meaning of a code: a reason ('' keeps the cloud's own), a remedy, the kind of error."""

    reason: str
    hint: str
    kind: type[FogError] = ProviderError


class CodedError(CloudError):
    """
    A cloud refused with ``code``; a cloud's subclass has the tables.

    :ivar temporary: the cloud did nothing, or has a fault, and the same request may succeed.
    :ivar pause: seconds after which the cloud asks for the next attempt, if it says so.
    """

    TITLE: ClassVar[str]
    FAILURES: ClassVar[Mapping[str, Failure]]
    #: No capacity in this zone; the quota of this region is used up.
    NO_ROOM_IN_ZONE: ClassVar[Collection[str]] = ()
    NO_ROOM_IN_REGION: ClassVar[Collection[str]] = ()
    #: The resource does not exist (any more); the credentials must not do that.
    GONE: ClassVar[Collection[str]] = ()
    DENIED: ClassVar[Collection[str]] = ()
    TEMPORARY: ClassVar[Collection[str]] = ()

    def __init__(
        self, message: str, hint: str = '', *, code: str = '', status: int = 400,
    ) -> None:
        super().__init__(
            message, hint, gone=code in self.GONE, denied=code in self.DENIED,
            full='zone' if code in self.NO_ROOM_IN_ZONE else
            'region' if code in self.NO_ROOM_IN_REGION else '')
        self.code = code
        fault = status >= 500 and not self.full
        self.temporary = fault or status == 429 or code in self.TEMPORARY
        # after a fault of the cloud, the request may have had its effect
        self.refused = not fault
        self.pause: Optional[float] = None

    @classmethod
    def of(cls, code: str, said: str, what: str, status: int = 400) -> FogError:
        """
        Return the error for a code.

        :param said: the cloud's own words, in one line.
        :param what: completes '... failed'.
        :param status: of HTTP.
        """
        known = cls.FAILURES.get(code) or Failure('', '')
        reason = known.reason or said or code or f'{cls.TITLE} gave no reason'
        message = f'{what} failed: {reason}' + f' [{code}]' * bool(code and code not in reason)
        if known.kind is ProviderError:
            return cls(message, known.hint, code=code, status=status)
        found = known.kind(message, known.hint)
        found.refused = status < 500
        return found


class Silent(PrerequisiteError):
    """
    A request got no answer.

    :param unsent: it did not leave this computer.
    """

    pause: Optional[float] = None

    def __init__(self, message: str, hint: str, *, unsent: bool) -> None:
        super().__init__(message, hint)
        self.refused, self.temporary = unsent, not unsent


def one_line(text: object) -> str:
    """Return the beginning of a text, such as an error's, in one line."""
    return ' '.join(str(text).split())[:LENGTH]


def not_the_cloud(title: str, what: str, status: int) -> FogError:
    """Return the error for an answer that only another server can have given."""
    return PrerequisiteError(f'{what} failed: what answered is not {title} (HTTP {status})',
                             'is there a proxy, or a page to log in to this network?')
