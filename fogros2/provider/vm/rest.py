# SPDX-License-Identifier: Apache-2.0
"""Requests to a cloud's REST API: session, token, time-outs, errors as FogErrors."""

from __future__ import annotations

import abc
from collections.abc import Mapping
import functools
from typing import Any, ClassVar, NamedTuple, Optional

from fogros2.errors import FogError
from fogros2.provider.vm.account import Account
from fogros2.provider.vm.failures import CodedError, Fields, not_the_cloud, one_line, Silent
from fogros2.waiting import ON_ITS_WAY


class Answer(NamedTuple):
    """An answer: HTTP status, headers, and the JSON of the body, None if it needs none."""

    status: int
    headers: Mapping[str, str]
    body: Any


@functools.lru_cache(maxsize=1)
def _session() -> Any:
    """Return the connections of this process; ``requests`` is imported when first needed."""
    import requests
    session = requests.Session()
    session.auth = unchanged
    for scheme in ('https://', 'http://'):
        session.mount(scheme, requests.adapters.HTTPAdapter(pool_maxsize=20))
    return session


def unchanged(request: Any) -> Any:
    """Authenticate a session's requests by their headers, not by a password of ``~/.netrc``."""
    return request


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
        """Return the error for an answer with an error; ``body`` is its JSON, a text or None."""

    def ask(
        self, method: str, url: str, what: str, body: Any = None, *, repeatable: bool = True,
        query: Optional[Mapping[str, str]] = None, timeout: float = 30.0, grace: bool = True,
    ) -> Answer:
        """
        Make one request and return its answer; see :meth:`repeated`.

        :param grace: wait for the answer to a sent request after a cancel.
        """
        # after a dead connection, time is left for another before the machine counts as lost
        first = iter([min(timeout, 20.0)] if method == 'GET' else ())
        return self.repeated(
            lambda: self._send(method, url, what, body, query, next(first, timeout)), what,
            reads=method == 'GET', repeatable=repeatable, grace=ON_ITS_WAY if grace else 0.0)

    def _send(
        self, method: str, url: str, what: str, body: Any, query: Optional[Mapping[str, str]],
        timeout: float,
    ) -> Answer:
        import requests
        import urllib3

        head = {'Authorization': f'Bearer {self.token(what)}'}
        try:
            answer = _session().request(
                method, url, params=query, json=body, headers=head, allow_redirects=False,
                timeout=(5.0, 5.0 if self.hasty else timeout))
        except requests.RequestException as error:
            # urllib3 gives up after its attempts to connect; a lost answer is another error
            unsent = next((each for each in error.args
                           if isinstance(each, urllib3.exceptions.MaxRetryError)), None)
            raise self.silent(unsent and unsent.reason or error, what, bool(unsent)) from error
        try:
            content = answer.json() if answer.content else None
        except ValueError:
            content = answer.text
        if answer.status_code >= 300:
            refused = self.refusal(answer.status_code, content, what)
            pause = answer.headers.get('Retry-After', '')
            if isinstance(refused, CodedError) and pause.isdecimal():
                refused.pause = float(pause)
            raise refused
        if content is not None and not isinstance(content, dict):
            raise not_the_cloud(self.TITLE, what, answer.status_code)
        if content is not None or method in ('GET', 'PUT') and answer.status_code != 202:
            content = Fields(content or {}, self.TITLE, what)
        return Answer(answer.status_code, answer.headers, content)

    def silent(self, reason: object, what: str, unsent: bool = True) -> Silent:
        """Return the error for a request without an answer."""
        return Silent(
            f'{what} failed: {self.TITLE} does not answer: {one_line(reason)}',
            f'is there a way to the Internet (a proxy, {self.ENDPOINT_VARIABLE})?', unsent=unsent)
