# SPDX-License-Identifier: Apache-2.0
"""Requests to Azure Resource Manager: credentials, long-running operations, pages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import json
import os
import re
import threading
import time
from typing import Any, Optional
from urllib.parse import urlsplit

from fogros2.clock import ServerClock
from fogros2.errors import FogError, PrerequisiteError, ProviderError
from fogros2.provider.azure import login
from fogros2.provider.azure.failures import refusal
from fogros2.provider.vm.failures import one_line, unless_gone, wait_through
from fogros2.provider.vm.rest import Answer, RestAccount

#: Names another endpoint than the public cloud's, such as a sovereign cloud's.
ENDPOINT_VARIABLE, ENDPOINT = 'FOGROS2_AZURE_ENDPOINT', 'https://management.azure.com'
#: Versions of the API, by the first of these words that the path contains.
VERSIONS = {
    'Microsoft.Authorization/roleDefinitions': '2022-04-01',
    'Microsoft.Authorization': '2022-04-01', 'Microsoft.DevTestLab': '2018-09-15',
    'Microsoft.Resources/tags': '2021-04-01', 'Microsoft.Compute/skus': '2021-07-01',
    'Microsoft.Compute/snapshots': '2024-03-02', 'Microsoft.Compute/disks': '2024-03-02',
    'Microsoft.Compute/galleries': '2024-03-03',
    'Microsoft.Compute': '2024-07-01', 'Microsoft.Network': '2024-05-01',
    '': '2022-09-01'}
#: Seconds for an operation; the deletion of a group takes a minute or two.
OPERATION = 900.0
#: Seconds before its end at which a token is renewed.
EARLY = 300.0
#: In azure-identity's messages: it has no way to a server. Its exceptions do not tell.
_NO_WAY = re.compile(
    'Failed to resolve.*|Failed to establish.*|Max retries exceeded.*|timed out.*|'
    'Connection aborted.*')


def endpoint() -> str:
    """Return the address of Azure Resource Manager."""
    return os.environ.get(ENDPOINT_VARIABLE, ENDPOINT).rstrip('/')


def subscription() -> str:
    """
    Return the id of the user's subscription: of the environment, else of ``az login``.

    :raises PrerequisiteError: none is named.
    """
    named = os.environ.get('AZURE_SUBSCRIPTION_ID', '')
    if not named:
        try:
            profile = json.loads(login.file('azureProfile.json').read_text(encoding='utf-8-sig'))
            named = next((str(entry['id']) for entry in profile['subscriptions']
                          if entry.get('isDefault')), '')
        except (OSError, ValueError, KeyError, TypeError):
            named = ''
    if not named:
        raise PrerequisiteError('no subscription of Azure is named on this computer',
                                'az login, or set AZURE_SUBSCRIPTION_ID')
    return named


class Account(RestAccount):
    """The user's account, with the usual chain of credentials of azure-identity."""

    TITLE = 'Azure'
    ENDPOINT_VARIABLE = ENDPOINT_VARIABLE

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.Lock()
        self.clock = ServerClock()
        #: Machines that this process has just created, as Azure reports them.
        self.seen: dict[str, Mapping[str, Any]] = {}

    def credential(self) -> Any:
        """
        Return the credential, made when first needed.

        :raises PrerequisiteError: azure-identity is not installed.
        """
        try:
            from azure.identity import DefaultAzureCredential
        except ImportError as error:
            raise PrerequisiteError(
                'machines at Azure take azure-identity, which is not installed',
                'python3 -m pip install azure-identity requests') from error
        with self._lock:
            # ``repeated`` connects again
            return self.once('credential', lambda: DefaultAzureCredential(
                connection_timeout=5.0, read_timeout=30.0, retry_connect=0))

    def path(self, group: str = '', rest: str = '') -> str:
        """Return the path of a resource of a group, or of the subscription."""
        words = [f'/subscriptions/{subscription()}', group and f'resourceGroups/{group}', rest]
        return '/'.join(filter(None, words))

    def vm(self, name: str, rest: str = '') -> str:
        """Return the path of a machine, whose group has its name."""
        return self.path(name, f'providers/Microsoft.Compute/virtualMachines/{name}{rest}')

    def call(
        self, method: str, path: str, what: str, body: Optional[Mapping[str, Any]] = None, *,
        wait: bool = False, query: Optional[Mapping[str, str]] = None,
    ) -> Any:
        """
        Make one request and return the answer's JSON, None if it has none.

        :param path: below the endpoint, without the version.
        :param wait: until a long-running operation is over.
        :raises FogError: see :func:`~fogros2.provider.azure.failures.refusal`.
        """
        version = next(word for key, word in VERSIONS.items() if key.lower() in path.lower())
        _, headers, answer = self._below(
            method, endpoint() + path, what, body, {'api-version': version, **(query or {})})
        operation = headers.get('Azure-AsyncOperation') or headers.get('Location')
        # a change of a resource is answered with 200 and takes an operation, too
        if not wait or not operation or _state(answer) == 'Succeeded':
            return answer

        def look() -> Any:
            # the resource of a PUT has its state: no other request is needed for the operation
            resource = self.call('GET', path, what) if method == 'PUT' else True
            state = _state(resource)
            if resource is not True and state not in ('Succeeded', 'Failed', 'Canceled'):
                return None
            return resource if state == 'Succeeded' or self._over(operation, what) else None

        # a group takes longer than what is in it
        first = 0.3 if '/providers/' in path else 1.5
        return wait_through(look, timeout=OPERATION, cancel=self.cancel, first=first, interval=1.0,
                            longest=8.0, what=f'{what} to be done')

    def pages(self, path: str, what: str, **query: str) -> Iterator[Mapping[str, Any]]:
        """Yield the entries of a list."""
        answer = self.call('GET', path, what, query=query)
        while True:
            yield from answer['value']
            if not answer.get('nextLink'):
                return
            answer = self._below('GET', answer['nextLink'], what).body

    def public(self, url: str, what: str, query: Mapping[str, str]) -> Iterator[Mapping[str, Any]]:
        """Yield the entries of a public list of Azure's, which takes no credentials."""
        import requests

        while url:
            try:
                answer = requests.get(url, params=query, timeout=5.0 if self.hasty else 30.0)
                answer.raise_for_status()
                page = answer.json()
                yield from page['Items']
                url, query = page.get('NextPageLink') or '', {}
            except (requests.RequestException, ValueError, KeyError, TypeError) as error:
                raise ProviderError(f'{what} failed: {error}') from error

    def delete(
        self, path: str, what: str, *, wait: bool = False,
        query: Optional[Mapping[str, str]] = None,
    ) -> None:
        """Delete something; it may be deleted already."""
        with unless_gone():
            self.call('DELETE', path, what, wait=wait, query=query)

    def _over(self, operation: str, what: str) -> bool:
        """Return whether an operation has succeeded; raise its error."""
        status, _, answer = self._below('GET', operation, what)
        state = str((answer or {}).get('status', '')).lower()
        if state in ('failed', 'canceled'):
            raise refusal(400, answer, what)
        return status != 202 and state in ('', 'succeeded')

    def _below(
        self, method: str, url: str, what: str, body: Optional[Mapping[str, Any]] = None,
        query: Optional[Mapping[str, str]] = None,
    ) -> Answer:
        """Make a request below the endpoint, which alone gets the token."""
        if _server(url) != _server(endpoint()):
            raise ProviderError(f'{what} failed: Azure named another server, {url[:100]}')
        answer = self.ask(method, url, what, body, query=query)
        self.clock.note(answer.headers.get('Date', ''))
        return answer

    def refusal(self, status: int, body: Any, what: str) -> FogError:
        return refusal(status, body, what)

    def token(self, what: str) -> str:
        """Return a token, which is kept as long as it is valid: some credentials keep none."""
        from azure.core.exceptions import AzureError as LibraryError
        from azure.core.exceptions import ClientAuthenticationError

        credential, scope = self.credential(), f'{endpoint()}/.default'
        try:
            with self._lock:
                token = self._known.get(scope)
                if token is None or token.expires_on < time.time() + EARLY:
                    token = self._known[scope] = credential.get_token(scope)
            return str(token.token)
        except LibraryError as error:
            reason = _NO_WAY.search(str(error))
            if reason or not isinstance(error, ClientAuthenticationError):
                raise self.silent(reason[0] if reason else error, what) from error
            raise PrerequisiteError(
                f'{what} failed: there are no credentials for Azure: {one_line(error)}',
                'az login, or set AZURE_TENANT_ID, AZURE_CLIENT_ID and AZURE_CLIENT_SECRET',
            ) from error


def _server(url: str) -> str:
    """Return scheme, host and port of an address; the scheme's own port is left out."""
    try:
        parts = urlsplit(url)
    except ValueError:
        return ''
    port = {'https': ':443', 'http': ':80'}.get(parts.scheme, '')
    # text is compared: parsers differ about what is the host in 'https://a\\@b'
    return f'{parts.scheme}://{parts.netloc.lower().removesuffix(port)}'


def _state(answer: Any) -> str:
    return str(answer['properties'].get('provisioningState')) if isinstance(answer, dict) else ''
