# SPDX-License-Identifier: Apache-2.0
"""Requests to a cloud's REST API: session, token, retries, time-outs, errors as FogErrors."""

from __future__ import annotations

import abc
from collections.abc import Mapping
import functools
import threading
from typing import Any, ClassVar, NamedTuple, Optional

from fogros2.errors import Cancelled, FogError
from fogros2.provider.vm.cloud import Account
from fogros2.provider.vm.failures import CodedError, not_the_cloud, one_line, Silent
from fogros2.waiting import cancellable

#: Attempts of a request that the cloud throttles or that fails there; without any answer, two.
ATTEMPTS = 6
#: Seconds of the first pause between attempts, which doubles, and of the longest.
PAUSE, LONGEST = 1.0, 20.0
#: Seconds to wait for the answer to a sent request, which may create something.
ON_ITS_WAY = 4.0


class Answer(NamedTuple):
    """An answer: HTTP status, headers, and the JSON of the body, None without one."""

    status: int
    headers: Mapping[str, str]
    body: Any


@functools.lru_cache(maxsize=1)
def _session() -> Any:
    """Return the connections of this process; ``requests`` is imported when first needed."""
    import requests
    session = requests.Session()
    for scheme in ('https://', 'http://'):
        session.mount(scheme, requests.adapters.HTTPAdapter(pool_maxsize=20))
    return session


class RestAccount(Account, abc.ABC):
    """The user's account at a cloud with a REST API."""

    TITLE: ClassVar[str]
    #: Names another address of the API.
    ENDPOINT_VARIABLE: ClassVar[str]

    @abc.abstractmethod
    def token(self, what: str) -> str:
        """
        Return a valid access token.

        :raises PrerequisiteError: there are no credentials, or they are not accepted.
        """

    @abc.abstractmethod
    def refusal(self, status: int, body: Any, what: str) -> FogError:
        """Return the error for an answer with an error; ``body`` is None if it is not JSON."""

    def ask(
        self, method: str, url: str, what: str, body: Any = None, *, repeatable: bool = True,
        query: Optional[Mapping[str, str]] = None, timeout: float = 30.0, grace: bool = True,
    ) -> Answer:
        """
        Make one request, again after a temporary failure, and return its answer.

        :param what: completes '... failed'.
        :param repeatable: the same request has its effect once, however often it is sent.
        :param grace: wait for the answer to a sent request after a cancel.
        :raises FogError: with ``refused`` set to False if it may have had an effect.
        """
        unsure = False
        for attempt in range(1, ATTEMPTS + 1):
            try:
                return cancellable(
                    lambda: self._send(method, url, what, body, query, timeout), self.cancel,
                    what=what, grace=lambda: ON_ITS_WAY if grace and method != 'GET' else 0.0)
            except (CodedError, Silent) as error:
                unsure = unsure or not error.refused
                error.refused = not unsure
                silent = isinstance(error, Silent)
                if not error.temporary or silent and not repeatable \
                        or attempt >= (2 if silent or self.hasty else ATTEMPTS):
                    raise
                pause = PAUSE * 2 ** (attempt - 1) if error.pause is None else error.pause
            except FogError as error:
                error.refused = not unsure and not isinstance(error, Cancelled)
                raise
            (self.cancel or threading.Event()).wait(min(pause, LONGEST))
        raise AssertionError('the last attempt returns or raises')

    def _send(
        self, method: str, url: str, what: str, body: Any, query: Optional[Mapping[str, str]],
        timeout: float,
    ) -> Answer:
        import requests

        head = {'Authorization': f'Bearer {self.token(what)}'}
        if self.cancel is not None and self.cancel.is_set():
            raise Cancelled(what)  # nobody waits for this thread
        try:
            answer = _session().request(
                method, url, params=query, json=body, headers=head, allow_redirects=False,
                timeout=(5.0, 5.0 if self.hasty else timeout))
        except requests.RequestException as error:
            raise self.silent(error, what, isinstance(error, requests.ConnectTimeout)) from error
        try:
            found = answer.json() if answer.content else None
        except ValueError:
            found = answer.text
        if answer.status_code >= 300:
            refused = self.refusal(answer.status_code, found, what)
            pause = answer.headers.get('Retry-After', '')
            if isinstance(refused, CodedError) and pause.isdigit():
                refused.pause = float(pause)
            raise refused
        if found is not None and not isinstance(found, dict):
            raise not_the_cloud(self.TITLE, what, answer.status_code)
        return Answer(answer.status_code, answer.headers, found)

    def silent(self, error: BaseException, what: str, unsent: bool = True) -> Silent:
        """Return the error for a request without an answer; it is made again if it was sent."""
        return Silent(
            f'{what} failed: {self.TITLE} does not answer: {one_line(error)}',
            f'is there a way to the Internet (a proxy, {self.ENDPOINT_VARIABLE})?', unsent=unsent)
