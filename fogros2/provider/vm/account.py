# SPDX-License-Identifier: Apache-2.0
"""The user's account at a cloud: its requests are made again after a temporary failure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import copy
import threading
import time
from typing import Any, Optional, TypeVar

from fogros2.errors import Cancelled, FogError
from fogros2.provider.vm.failures import CodedError, Silent
from fogros2.waiting import cancellable, ON_ITS_WAY

#: Attempts of a request that the cloud throttles or that fails there; without any answer, two.
ATTEMPTS = 8
#: Seconds of the first pause between attempts, which doubles, and of the longest.
PAUSE, LONGEST = 1.0, 20.0
#: Seconds for further attempts after one that did not leave this computer.
UNSENT = 10.0

Own = TypeVar('Own', bound='Account')
T = TypeVar('T')


class Account:
    """The user's account at a cloud; thread-safe."""

    #: Set when the launch ends; calls then raise Cancelled.
    cancel: Optional[threading.Event] = None
    #: Short time-outs and few attempts, because a user waits for the answer.
    hasty = False

    def __init__(self) -> None:
        self._known: dict[str, Any] = {}
        #: Networks to which this process has opened the SSH port of a new machine, by attempt.
        self.admitted: dict[str, list[str]] = {}

    def having(self: Own, cancel: Optional[threading.Event], *, hasty: bool = False) -> Own:
        """Return this account for calls that end with ``cancel``; it shares what is known."""
        other = copy.copy(self)
        other.cancel, other.hasty = cancel, hasty
        return other

    def once(self, key: str, ask: Callable[[], T]) -> T:
        """Return the answer to a question that is asked once in this process."""
        if key not in self._known:
            self._known[key] = ask()
        answer: T = self._known[key]
        return answer

    def admits(self, attempt: str, networks: Sequence[str]) -> bool:
        """
        Return whether a machine's SSH port is as this process has made it: open to ``networks``.

        A launch asks again while a machine boots. With other networks, the port is changed next.
        """
        if networks and self.admitted.get(attempt) == [*networks]:
            return True
        self.admitted.pop(attempt, None)
        return False

    def repeated(
        self, send: Callable[[], T], what: str, *, reads: bool, repeatable: bool = True,
        grace: float = ON_ITS_WAY,
    ) -> T:
        """
        Make one request, again after a temporary failure, and return its answer.

        :param what: completes '... failed'.
        :param reads: it changes nothing.
        :param repeatable: the same request has its effect once, however often it is sent.
        :param grace: seconds for the answer to a sent request after a cancel.
        :raises FogError: with ``refused`` set to False if it may have had an effect.
        """
        sent = unsure = False
        end = 0.0

        def ask() -> T:
            nonlocal sent
            if self.cancel is not None and self.cancel.is_set():
                raise Cancelled(what)  # nobody waits for this thread
            sent = not reads
            return send()

        def patience() -> float:
            return grace if sent else 0.0

        for attempt in range(1, ATTEMPTS + 1):
            try:
                return cancellable(ask, self.cancel, what=what, grace=patience)
            except (CodedError, Silent) as error:
                sent = False
                harmless = repeatable or error.refused
                unsure = unsure or not error.refused
                error.refused = not unsure
                pause = min(LONGEST, PAUSE * 2 ** (attempt - 1) if error.pause is None
                            else error.pause)
                if not isinstance(error, Silent):
                    last = not error.temporary or not harmless or self.hasty and attempt >= 2
                elif error.unsent:
                    end = end or time.monotonic() + UNSENT
                    last = self.hasty or time.monotonic() + pause > end
                else:
                    last = not harmless or attempt >= 2
                if last or attempt == ATTEMPTS:
                    raise
            except FogError as error:
                error.refused = not unsure and not (sent and error.refused is False)
                raise
            (self.cancel or threading.Event()).wait(pause)
        raise AssertionError('the last attempt returns or raises')
