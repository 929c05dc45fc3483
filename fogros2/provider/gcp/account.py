# SPDX-License-Identifier: Apache-2.0
"""Requests to Compute Engine's REST API: credentials, operations that take time, pages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import copy
import functools
import os
import threading
from typing import Any, cast, Optional
import uuid
import warnings

from fogros2.errors import FogError, PrerequisiteError
from fogros2.provider.gcp import failures, login
from fogros2.provider.vm.failures import (
    Fields,
    one_line,
    tolerated,
    unless_gone,
    wait_through,
)
from fogros2.provider.vm.rest import RestAccount, unchanged

#: The API, and gcloud's own variable that names another address.
ENDPOINT = 'https://compute.googleapis.com/compute/v1/'
ENDPOINT_VARIABLE = 'CLOUDSDK_API_ENDPOINT_OVERRIDES_COMPUTE'
_SCOPES = ('https://www.googleapis.com/auth/cloud-platform',)
#: Variables on which the credentials depend.
_VARIABLES = (
    'GOOGLE_APPLICATION_CREDENTIALS', 'GOOGLE_CLOUD_PROJECT', 'CLOUDSDK_CONFIG', 'HOME')
#: Time-out in seconds of an operation, and of a request that waits for one: two minutes there.
OPERATION_TIMEOUT, WAIT_TIMEOUT = 300.0, 140.0


@functools.lru_cache(maxsize=4)
def _login(*settings: str) -> tuple[Any, str]:
    """
    Return the credentials of this computer's user, and the project of their configuration.

    :param settings: the values of ``_VARIABLES``.
    """
    try:
        import google.auth
        from google.auth.exceptions import GoogleAuthError
        import google.auth.transport.requests
    except ImportError as error:
        raise PrerequisiteError(
            'machines at Google take google-auth and requests, which are not installed',
            'python3 -m pip install google-auth requests') from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of credentials of a person
            # any, because the library has types for a part of it
            credentials, project = cast(Any, google.auth).default(scopes=_SCOPES)
    except GoogleAuthError as error:
        raise PrerequisiteError(f"the Google credentials can't be read: {error}",
                                'gcloud auth application-default login') from error
    return credentials, str(project or '')


#: Held while a token is renewed.
_RENEWING = threading.Lock()


class Account(RestAccount):
    """
    A project of Google Cloud, with the credentials of this computer's user.

    :param project: '' for the project of the user's configuration.
    """

    TITLE = 'Google'
    ENDPOINT_VARIABLE = ENDPOINT_VARIABLE

    def __init__(self, project: str = '') -> None:
        super().__init__()
        self._project = project
        #: Fingerprint of the labels of instances, by id, as last reported.
        self.labels: dict[str, tuple[str, Mapping[str, str]]] = {}

    def of_project(self, project: str) -> Account:
        """Return the account of another project; '' for the same."""
        other = copy.copy(self)
        other._project = project or self._project
        return other

    def _opened(self) -> tuple[Any, str]:
        if not login.configured():
            raise PrerequisiteError(
                'there are no Google credentials on this computer',
                f'gcloud auth application-default login, or set {login.VARIABLE}')
        if not login.credentials().is_file():
            raise PrerequisiteError(f"{login.VARIABLE} names '{login.credentials()}', and there "
                                    'is no such file', 'correct the path, or unset the variable')
        return _login(*(os.environ.get(name, '') for name in _VARIABLES))

    @property
    def endpoint(self) -> str:
        """The address of the API, with a slash at its end."""
        return os.environ.get(ENDPOINT_VARIABLE, ENDPOINT).rstrip('/') + '/'

    @property
    def project(self) -> str:
        """
        The project's id.

        :raises PrerequisiteError: there are no credentials, or nobody has named a project.
        """
        project = self._project or self._opened()[1]
        if not project:
            raise PrerequisiteError('no project of Google Cloud is named',
                                    "project_id='...', or set GOOGLE_CLOUD_PROJECT")
        return project

    def check(self) -> None:
        self._opened()
        _ = self.project

    def token(self, what: str) -> str:
        credentials, _ = self._opened()
        from google.auth.exceptions import GoogleAuthError, RefreshError, TransportError
        from google.auth.transport.requests import Request

        def renew() -> None:
            if not credentials.valid:
                request = cast(Any, Request)()
                request.session.auth = unchanged
                credentials.refresh(functools.partial(
                    request, timeout=(5.0, 5.0 if self.hasty else 30.0)))

        try:
            with _RENEWING:
                try:
                    renew()
                except RefreshError:
                    # the user may have logged in again since
                    _login.cache_clear()
                    credentials, _ = self._opened()
                    renew()
            return str(credentials.token)
        except GoogleAuthError as error:
            # a page is no refusal: those are JSON
            if isinstance(error, TransportError) or error.retryable \
                    or str(error).lstrip().startswith('<'):
                raise self.silent(error, what) from error
            raise PrerequisiteError(
                f'{what} failed: Google does not take these credentials: '
                f'{one_line(error.args[0])}',
                'gcloud auth application-default login; is the clock of this computer right?',
            ) from error

    def refusal(self, status: int, body: Any, what: str) -> FogError:
        return failures.refused(status, body, what)

    def call(
        self, method: str, path: str, what: str, *, body: Any = None, **query: str,
    ) -> dict[str, Any]:
        """
        Make one request and return its answer.

        :param path: below ``projects/``.
        :raises GoogleError: Google refused; ``refused`` is False if it may have had an effect.
        :raises PrerequisiteError: no credentials, bad ones, no route to Google.
        """
        waits = path.endswith('/wait')
        if method != 'GET' and not waits:
            # Google carries out a repeated request with the same id once
            query.setdefault('requestId', str(uuid.uuid4()))
        answer: dict[str, Any] = self.ask(
            method, f'{self.endpoint}projects/{path}', what, body, query=query, grace=not waits,
            timeout=WAIT_TIMEOUT if waits else 30.0).body or Fields({}, self.TITLE, what)
        return answer

    def run(
        self, method: str, path: str, what: str, *, body: Any = None, **query: str,
    ) -> dict[str, Any]:
        """
        Make a request that starts an operation, and return the operation when it has ended.

        :raises GoogleError: the request was refused, or the operation failed.
        """
        operation = self.call(method, path, what, body=body, **query)
        scope = path.partition('/')[0] + (
            f'/zones/{operation["zone"].rpartition("/")[2]}' if 'zone' in operation else '/global')
        place = f'{scope}/operations/{operation["name"]}/wait'

        def done() -> Optional[dict[str, Any]]:
            answer = self.call('POST', place, what)
            return answer if answer['status'] == 'DONE' else None

        if operation['status'] != 'DONE':
            try:
                operation = wait_through(
                    done, timeout=OPERATION_TIMEOUT, cancel=self.cancel, interval=0.5,
                    longest=5.0, what=f'the end of: {what}',
                    hint='the console of Google Cloud has its operations')
            except FogError as error:
                error.refused = False  # the operation continues
                raise
        if operation.get('error', {}).get('errors'):
            raise failures.failed(operation, what)
        return operation

    def create(self, path: str, what: str, body: Any, **query: str) -> bool:
        """Create something; return whether it was there already, from an earlier attempt."""
        with tolerated('ALREADY_EXISTS', 'RESOURCE_ALREADY_EXISTS'):
            self.run('POST', path, what, body=body, **query)
            return False
        return True

    def remove(self, path: str, what: str) -> None:
        """Delete something, which may be deleted already; return when it is gone."""
        with unless_gone():
            self.run('DELETE', path, what)

    def pages(self, path: str, what: str, **query: str) -> Iterator[Mapping[str, Any]]:
        """Yield the entries of all pages of a list, or of a list over all zones."""
        while True:
            answer = self.call('GET', path, what, **query)
            items = answer.get('items') or ()
            if isinstance(items, dict):
                key = path.rpartition('/')[2]
                items = [entry for scope in items.values() for entry in scope.get(key, ())]
            yield from items
            if not answer.get('nextPageToken'):
                return
            query['pageToken'] = answer['nextPageToken']
