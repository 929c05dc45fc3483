# SPDX-License-Identifier: Apache-2.0
"""boto3's clients: one for each service and region, with time-outs, errors as FogErrors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import functools
import os
import threading
import time
from typing import Any, Optional, TypeVar

from fogros2.errors import PrerequisiteError
from fogros2.provider.aws.failures import Expired, translated
from fogros2.provider.vm import account as vm
from fogros2.provider.vm.failures import Fields, SETTLING, unless_gone

T = TypeVar('T')

CONNECT_TIMEOUT, READ_TIMEOUT = 5.0, 20.0


def usual() -> Account:
    """
    Return the account of this computer's user, the same for all callers in this process.

    A session and its clients take half a second to create.
    """
    return _account(*sorted((name, value) for name, value in os.environ.items()
                            if name.startswith('AWS_') or name == 'HOME'))


class Account(vm.Account):
    """
    An AWS account as boto3 finds it (variables, files, roles); thread-safe.

    ``AWS_ENDPOINT_URL`` leads every call to another server, as boto3 has it.

    :param session: a ``boto3.session.Session``; None for the usual one, made when first needed.
    """

    def __init__(self, session: Optional[Any] = None) -> None:
        super().__init__()
        self._given = session
        #: Instances and groups that this process has created, and when (``time.monotonic``).
        self.made: dict[str, float] = {}
        # boto3 creates clients of one session in one thread only; their use is thread-safe
        self._lock = threading.RLock()

    def just_made(self, identity: str) -> bool:
        """Return whether EC2 may not know yet what this process has created."""
        made = self.made.get(identity)
        return made is not None and time.monotonic() - made < SETTLING

    def session(self) -> Any:
        """
        Return the boto3 session.

        :raises PrerequisiteError: boto3 is not installed, or its configuration is not readable.
        """
        with self._lock:
            return self._given or self.once('session', _session)

    def check_credentials(self) -> None:
        session = self.session()
        with translated('looking for AWS credentials'):
            with self._lock:
                credentials = session.get_credentials()
        if credentials is None:
            raise PrerequisiteError(
                'there are no AWS credentials on this computer',
                'aws configure, or set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY')

    def client(self, service: str, region: str, *, hasty: bool = False) -> Any:
        """
        Return the client of a service in a region.

        :param hasty: short time-outs and few attempts, because a user waits for the answer.
        """
        def made() -> Any:
            session = self.session()
            from botocore.config import Config
            config = Config(
                # ``repeated`` makes them again: nothing can end the pauses of boto3
                retries={'mode': 'standard', 'total_max_attempts': 1},
                connect_timeout=3.0 if hasty else CONNECT_TIMEOUT,
                read_timeout=5.0 if hasty else READ_TIMEOUT,
                user_agent_extra='fogros2', max_pool_connections=50)
            with translated(f"reaching AWS's {service}", region):
                return session.client(service, region_name=region, config=config)

        with self._lock:
            return self.once(f'{service} {region} {hasty}', made)

    def call(
        self, service: str, region: str, operation: str, what: str, **parameters: Any,
    ) -> Mapping[str, Any]:
        """
        Make one call and return its answer.

        :param operation: as boto3's method is called.
        :raises FogError: see :func:`~fogros2.provider.aws.failures.translated`.
        """
        return self._ask(
            lambda client: Fields(getattr(client, operation)(**parameters), 'AWS', what), service,
            region, operation, what)

    def remove(self, region: str, operation: str, what: str, **parameters: Any) -> None:
        """Make a call of EC2 that deletes something; it may be deleted already."""
        with unless_gone():
            self.call('ec2', region, operation, what, **parameters)

    def pages(
        self, service: str, region: str, operation: str, key: str, what: str,
        **parameters: Any,
    ) -> Iterator[Mapping[str, Any]]:
        """Yield what all pages of an answer have under ``key``."""
        def ask(client: Any) -> list[Mapping[str, Any]]:
            return [entry for page in client.get_paginator(operation).paginate(**parameters)
                    for entry in Fields(page, 'AWS', what)[key]]

        yield from self._ask(ask, service, region, operation, what)

    def _ask(
        self, ask: Callable[[Any], T], service: str, region: str, operation: str, what: str,
    ) -> T:
        def sent(client: Any) -> T:
            with translated(what, region):
                return ask(client)

        def asked() -> T:
            client = self.client(service, region, hasty=self.hasty)
            try:
                return sent(client)
            except Expired:
                self._forget(client)
                return sent(self.client(service, region, hasty=self.hasty))

        return self.repeated(asked, what, reads=operation.startswith(('describe_', 'get_')))

    def _forget(self, client: Any) -> None:
        """Read the credentials again: the user may have renewed them."""
        with self._lock:
            # not if another thread has done it
            if client in self._known.values():
                self._known.clear()


@functools.lru_cache(maxsize=1)
def _account(*settings: tuple[str, str]) -> Account:
    """Return the account for these values of AWS's variables."""
    return Account()


def _session() -> Any:
    try:
        import boto3
    except ImportError as error:
        raise PrerequisiteError('machines at AWS take boto3, which is not installed',
                                'python3 -m pip install boto3') from error
    with translated('reading the AWS configuration'):
        return boto3.session.Session()
