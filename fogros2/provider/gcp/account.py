# SPDX-License-Identifier: Apache-2.0
"""Requests to Compute Engine's REST API: credentials, retries, operations that take time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import copy
import functools
import os
from pathlib import Path
import threading
import time
from typing import Any, cast, Optional
import uuid
import warnings

from fogros2.errors import DeadlineExceeded, FogError, PrerequisiteError
from fogros2.provider.gcp import failures
from fogros2.provider.gcp.failures import GoogleError
from fogros2.waiting import cancellable, wait_until

#: The API, and gcloud's own variable that names another address.
ENDPOINT = 'https://compute.googleapis.com/compute/v1/'
ENDPOINT_VARIABLE = 'CLOUDSDK_API_ENDPOINT_OVERRIDES_COMPUTE'
_SCOPES = ('https://www.googleapis.com/auth/cloud-platform',)
#: Variables on which the credentials depend.
_VARIABLES = (
    'GOOGLE_APPLICATION_CREDENTIALS', 'GOOGLE_CLOUD_PROJECT', 'CLOUDSDK_CONFIG', 'HOME')
#: Seconds in which a request is sent again that Google refuses, or does not answer.
PATIENCE, UNANSWERED = 20.0, 2.0
#: Seconds to wait for the answer to a sent request, which may create something.
ON_ITS_WAY = 4.0
#: Time-out in seconds of an operation; Google answers a waiting request within two minutes.
OPERATION_TIMEOUT = 300.0


def _credentials() -> Path:
    named = os.environ.get('GOOGLE_APPLICATION_CREDENTIALS', '')
    folder = Path(os.environ.get('CLOUDSDK_CONFIG') or '~/.config/gcloud').expanduser()
    return Path(named) if named else folder / 'application_default_credentials.json'


def configured() -> bool:
    """Return whether Google Cloud is set up here; read only files and variables."""
    return _credentials().is_file()


class _Login:
    """The credentials of this computer's user, with the project of their configuration."""

    def __init__(self) -> None:
        try:
            import google.auth
            from google.auth.exceptions import GoogleAuthError
            from google.auth.transport import requests as transport
            import requests
        except ImportError as error:
            raise PrerequisiteError(
                'machines at Google take google-auth and requests, which are not installed',
                'python3 -m pip install google-auth requests') from error
        try:
            with warnings.catch_warnings():
                warnings.simplefilter('ignore')  # of credentials of a person
                # any, because the library has types for a part of it
                self._credentials, project = cast(Any, google.auth).default(scopes=_SCOPES)
        except GoogleAuthError as error:
            raise PrerequisiteError(f"the Google credentials can't be read: {error}",
                                    'gcloud auth application-default login') from error
        self.project = str(project or '')
        self.session = requests.Session()
        self._request = cast(Any, transport).Request()
        self._lock = threading.Lock()

    def headers(self) -> dict[str, str]:
        """Return the headers of a request, with a token that is valid."""
        found: dict[str, str] = {}
        with self._lock:
            if not self._credentials.valid:
                self._credentials.refresh(self._request)
            self._credentials.apply(found)
        return found


@functools.lru_cache(maxsize=4)
def _login(*settings: str) -> _Login:
    """Return the login for these values of ``_VARIABLES``, once for all callers."""
    return _Login()


class Account:
    """
    A project of Google Cloud, with the credentials of this computer's user; thread-safe.

    :param project: '' for the project of the user's configuration.
    """

    def __init__(self, project: str = '') -> None:
        self._project = project
        #: Types of machines by project and region: each machine of a launch would ask again.
        self.types: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
        #: Fingerprint of the labels of instances, by id, as last reported.
        self.labels: dict[str, tuple[str, Mapping[str, str]]] = {}

    def of_project(self, project: str) -> Account:
        """Return the account of another project; '' for the same."""
        other = copy.copy(self)
        other._project = project or self._project
        return other

    def _opened(self) -> _Login:
        if not configured():
            raise PrerequisiteError(
                'there are no Google credentials on this computer',
                'gcloud auth application-default login, or set GOOGLE_APPLICATION_CREDENTIALS')
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
        project = self._project or self._opened().project
        if not project:
            raise PrerequisiteError('no project of Google Cloud is named',
                                    "project_id='...', or set GOOGLE_CLOUD_PROJECT")
        return project

    def check(self) -> None:
        """
        Check that there are credentials and a project, without a request.

        :raises PrerequisiteError: something is missing.
        """
        self._opened()
        _ = self.project

    def call(
        self, method: str, path: str, what: str, *, cancel: Optional[threading.Event] = None,
        body: Any = None, **query: str,
    ) -> dict[str, Any]:
        """
        Make one request, again after a temporary failure, and return its answer.

        :param path: below ``projects/``.
        :param what: completes '... failed'.
        :raises GoogleError: Google refused; ``refused`` is False if it may have had an effect.
        :raises PrerequisiteError: no credentials, bad ones, no route to Google.
        """
        changes = method != 'GET' and not path.endswith('/wait')
        if changes:
            # Google carries out a repeated request with the same id once
            query.setdefault('requestId', str(uuid.uuid4()))
        begin, unsure = time.monotonic(), False

        def attempt() -> Optional[dict[str, Any]]:
            nonlocal unsure
            try:
                return cancellable(
                    lambda: self._send(method, path, what, body, query), cancel, what=what,
                    grace=lambda: ON_ITS_WAY if changes else 0.0)
            except FogError as error:
                unsure = unsure or not error.refused
                if isinstance(error, GoogleError) and error.temporary \
                        and time.monotonic() - begin < (PATIENCE if error.code else UNANSWERED):
                    return None
                error.refused = not unsure
                raise

        return wait_until(attempt, timeout=2 * PATIENCE + OPERATION_TIMEOUT, cancel=cancel,
                          interval=0.5, longest=5.0, what=what)

    def _send(
        self, method: str, path: str, what: str, body: Any, query: Mapping[str, str],
    ) -> dict[str, Any]:
        from google.auth.exceptions import GoogleAuthError, TransportError
        import requests
        login = self._opened()
        try:
            answer = login.session.request(
                method, f'{self.endpoint}projects/{path}', params=query, json=body,
                headers=login.headers(),
                timeout=(5.0, 140.0 if path.endswith('/wait') else 30.0))
        except (requests.RequestException, TransportError) as error:
            unsent = isinstance(error, (requests.ConnectTimeout, TransportError))
            trouble = GoogleError(
                f'{what} failed: Google does not answer: {" ".join(str(error).split())[:200]}',
                f'is there a way to the Internet (a proxy, {ENDPOINT_VARIABLE})?')
            trouble.refused, trouble.temporary = unsent, not unsent
            raise trouble from error
        except GoogleAuthError as error:
            raise PrerequisiteError(
                f'{what} failed: Google does not take these credentials: {error.args[0]}',
                'gcloud auth application-default login; is the clock of this computer right?',
            ) from error
        try:
            found = answer.json() if answer.content else {}
        except ValueError:
            found = None
        if answer.status_code >= 400 or not isinstance(found, dict):
            raise failures.refused(answer.status_code, found, what)
        return found

    def run(
        self, method: str, path: str, what: str, *, cancel: Optional[threading.Event] = None,
        body: Any = None, **query: str,
    ) -> dict[str, Any]:
        """
        Make a request that starts an operation, and return the operation when it has ended.

        :raises GoogleError: the request was refused, or the operation failed.
        """
        operation = self.call(method, path, what, cancel=cancel, body=body, **query)
        scope = path.partition('/')[0] + (
            f'/zones/{operation["zone"].rpartition("/")[2]}' if 'zone' in operation else '/global')
        place = f'{scope}/operations/{operation["name"]}/wait'
        end = time.monotonic() + OPERATION_TIMEOUT
        while operation['status'] != 'DONE':
            if time.monotonic() > end:
                raise DeadlineExceeded(f'{what} has not ended in {OPERATION_TIMEOUT:g} s',
                                       'the console of Google Cloud has its operations')
            try:
                operation = self.call('POST', place, what, cancel=cancel)
            except FogError as error:
                error.refused = False  # the operation continues
                raise
        if operation.get('error', {}).get('errors'):
            raise failures.failed(operation, what)
        return operation

    def remove(self, path: str, what: str) -> None:
        """Delete something, which may be deleted already; return when it is gone."""
        try:
            self.run('DELETE', path, what)
        except GoogleError as error:
            if not error.gone:
                raise

    def pages(
        self, path: str, what: str, *, cancel: Optional[threading.Event] = None, **query: str,
    ) -> Iterator[Mapping[str, Any]]:
        """Yield the entries of all pages of a list, or of a list over all zones."""
        while True:
            answer = self.call('GET', path, what, cancel=cancel, **query)
            items = answer.get('items') or ()
            if isinstance(items, dict):
                key = path.rpartition('/')[2]
                items = [entry for scope in items.values() for entry in scope.get(key, ())]
            yield from items
            if not answer.get('nextPageToken'):
                return
            query['pageToken'] = answer['nextPageToken']
