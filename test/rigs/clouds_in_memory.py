# SPDX-License-Identifier: Apache-2.0
"""The clouds without computers, for tests that they all share: one adapter for each."""

from __future__ import annotations

import abc
import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import re
import threading
from typing import Any, ClassVar
from urllib.parse import parse_qsl

import pytest

from fogros2.provider.vm.provider import VmProvider
from fogros2.waiting import wait_until


class Memory(abc.ABC):
    """
    One cloud, simulated in this process.

    :param served: value of the fixture that serves it.
    :param patch: undoes its changes when the test ends.
    """

    #: The fixture of ``test/conftest.py``.
    fixture: ClassVar[str]
    name: ClassVar[str]
    #: Options of a machine, and the type to try next.
    options: ClassVar[Mapping[str, Any]]
    more: ClassVar[Mapping[str, Any]]
    #: Another region.
    away: ClassVar[str]
    #: The requests that create something, and how each can fail; see ``fail``.
    steps: ClassVar[Sequence[tuple[str, str]]]
    #: The most requests that list the machines of all regions.
    listing: ClassVar[int]
    #: The most requests of a launch.
    launching: ClassVar[int] = 25
    #: The method (or operation) of the request that deletes a machine.
    deletion: ClassVar[str] = 'DELETE'
    #: Whether a machine that has switched itself off is billed.
    billed_when_off: ClassVar[bool] = True

    def __init__(self, served: Any, patch: pytest.MonkeyPatch) -> None:
        self.served, self.patch = served, patch

    @contextlib.contextmanager
    def fault(self, how: str, times: int) -> Iterator[threading.Event]:
        """Disturb requests in the block, as ``VmContract`` describes; 'quota' is of a region."""
        met, over = threading.Event(), threading.Event()
        with self.patch.context() as patch:
            if how == 'silent':
                self.hold(patch, met, over)
            else:
                self.order(patch, how, times, met)
            try:
                yield met
            finally:
                over.set()
                self.heal()

    def hold(self, patch: pytest.MonkeyPatch, met: threading.Event, over: threading.Event) -> None:
        """Hold every request until ``over``."""
        import requests
        send = requests.Session.request

        def held(*words: Any, **options: Any) -> Any:
            met.set()
            over.wait(30.0)
            return send(*words, **options)

        patch.setattr(requests.Session, 'request', held)

    @contextlib.contextmanager
    def unconnected(self, times: int, *, after: str = '') -> Iterator[list[str]]:
        """
        Let no connection be made for the next ``times`` requests in the block.

        :param after: only those after a request with this method, or operation of EC2.
        :returns: the requests that failed.
        """
        failed: list[str] = []
        begun = not after

        def refused(word: str) -> bool:
            nonlocal begun
            lost = begun and len(failed) < times
            if lost:
                failed.append(word)
            begun = begun or word == after
            return lost

        with self.patch.context() as patch:
            self.disconnect(patch, refused)
            yield failed

    def disconnect(
        self, patch: pytest.MonkeyPatch, refused: Callable[[str], bool],
    ) -> None:
        """Let a request fail if ``refused`` returns True for its method."""
        import requests
        import urllib3
        send = requests.Session.request

        def sent(own: Any, method: str, *words: Any, **options: Any) -> Any:
            if refused(method):
                raise requests.ConnectTimeout(urllib3.exceptions.MaxRetryError(
                    urllib3.HTTPConnectionPool('cloud'), '/', OSError('the network is cut')))
            return send(own, method, *words, **options)

        patch.setattr(requests.Session, 'request', sent)

    @abc.abstractmethod
    def order(
        self, patch: pytest.MonkeyPatch, how: str, times: int, met: threading.Event,
    ) -> None:
        """Let the next requests for a machine fail; set ``met`` when one does."""

    @abc.abstractmethod
    def heal(self) -> None:
        """Forget the faults."""

    @abc.abstractmethod
    def user_data(self, machine_id: str) -> bytes:
        """Return the user data of a machine."""

    @abc.abstractmethod
    def provider(self) -> VmProvider:
        """Return a provider."""

    @abc.abstractmethod
    def left(self) -> bool:
        """Return whether anything is left of machines."""

    @abc.abstractmethod
    def calls(self) -> int:
        """Return the number of requests so far."""

    def open_catalogue(self) -> None:
        """Let the provider know prices."""

    def hurry(self) -> None:
        """Let operations take no time: each look at one is a request."""

    @abc.abstractmethod
    def fail(self, step: str, how: str) -> None:
        """
        Let a step fail from now on.

        :param how: 'refused', 'late' (its operation fails), or 'lost' (it has its effect, and
            its answer is an error).
        """

    @abc.abstractmethod
    def vanish(self) -> None:
        """Let all machines end, and nothing else."""


def _counted(fault: Any, met: threading.Event) -> Any:
    """Return a fault that sets ``met`` when its service counts it down."""
    class Counted(type(fault)):  # type: ignore[misc]
        def __setattr__(self, name: str, value: Any) -> None:
            super().__setattr__(name, value)
            met.set()

    fault.__class__ = Counted
    return fault


class Aws(Memory):
    """Moto's EC2."""

    billed_when_off = False

    fixture, name = 'moto_aws', 'aws'
    options = {'ec2_instance_type': 't3.medium', 'disk_size': 10}
    more, away = {'instance_types': ['t3.large']}, 'us-east-1'
    steps = tuple((step, how) for step in (
        'CreateSecurityGroup', 'AuthorizeSecurityGroupIngress', 'ImportKeyPair', 'RunInstances')
        for how in ('refused', 'lost'))
    listing = 2  # there are two regions
    launching = 17
    deletion = 'TerminateInstances'

    def __init__(self, served: Any, patch: pytest.MonkeyPatch) -> None:
        super().__init__(served, patch)
        from fogros2.provider.aws.clients import Account
        from rigs.ec2 import watched
        self._rig, self._watched = watched, watched.Watched()
        call, orders = Account.call, dict[str, Any]()

        def once(own: Any, service: str, region: str, asked: str, what: str, **words: Any) -> Any:
            # Moto ignores the token
            token = words.get('ClientToken')
            if token is None:
                return call(own, service, region, asked, what, **words)
            if token not in orders:
                orders[token] = call(own, service, region, asked, what, **words)
            return orders[token]

        patch.setattr(Account, 'call', once)

    def hold(self, patch: pytest.MonkeyPatch, met: threading.Event, over: threading.Event) -> None:
        """Hold every request of botocore."""
        from botocore.httpsession import URLLib3Session
        send = URLLib3Session.send

        def held(*words: Any) -> Any:
            met.set()
            over.wait(30.0)
            return send(*words)

        patch.setattr(URLLib3Session, 'send', held)

    def disconnect(
        self, patch: pytest.MonkeyPatch, refused: Callable[[str], bool],
    ) -> None:
        """Let a request of botocore fail if ``refused`` returns True for its operation."""
        from botocore.exceptions import ConnectTimeoutError
        from botocore.httpsession import URLLib3Session
        send = URLLib3Session.send

        def sent(own: Any, request: Any) -> Any:
            body = request.body or b''
            text = body.decode() if isinstance(body, bytes) else str(body)
            if refused(dict(parse_qsl(text)).get('Action', '')):
                raise ConnectTimeoutError(endpoint_url=request.url)
            return send(own, request)

        patch.setattr(URLLib3Session, 'send', sent)

    def order(
        self, patch: pytest.MonkeyPatch, how: str, times: int, met: threading.Event,
    ) -> None:
        """Refuse RunInstances, or lose its answers."""
        class Sent(list[str]):
            def append(self, code: str) -> None:
                met.set()

        if how == 'lost':
            self._lose(patch, 'run_instances', times, met)
            return
        patch.setattr(self._watched, 'sent', Sent())
        code = {'throttled': 'RequestLimitExceeded', 'unavailable': 'ServiceUnavailable',
                'full': 'InsufficientInstanceCapacity', 'quota': 'VcpuLimitExceeded'}[how]
        self._watched.refuse('RunInstances', *[code] * times,
                             status=503 if how == 'unavailable' else 400)

    def heal(self) -> None:
        """Refuse nothing."""
        self._watched.refusals.clear()

    def user_data(self, machine_id: str) -> bytes:
        """Return an attribute of the instance."""
        instance = machine_id.split('/')[1]
        return base64.b64decode(self._rig.ec2().describe_instance_attribute(
            InstanceId=instance, Attribute='userData')['UserData']['Value'])

    def provider(self) -> VmProvider:
        """Return the watched provider."""
        return self._watched.provider

    def left(self) -> bool:
        """Return whether there is anything."""
        return self._rig.left() != self._rig.NOTHING

    def calls(self) -> int:
        """Return the number of calls."""
        return len(self._watched.calls)

    def fail(self, step: str, how: str) -> None:
        """Refuse a call, or raise an error after it."""
        if how == 'refused':
            self._watched.refuse(step, *['UnauthorizedOperation'] * 9)
            return
        operation = re.sub('(?<!^)([A-Z])', r'_\1', step).lower()
        self._lose(self.patch, operation, 1000, threading.Event())

    def _lose(
        self, patch: pytest.MonkeyPatch, operation: str, times: int, met: threading.Event,
    ) -> None:
        """Raise an error after the next calls of an operation."""
        from fogros2.provider.aws.clients import Account
        from fogros2.provider.aws.failures import AwsError
        call, losses = Account.call, iter(range(times))

        def lost(own: Any, service: str, region: str, asked: str, what: str, **words: Any) -> Any:
            answer = call(own, service, region, asked, what, **words)
            if asked == operation and next(losses, None) is not None:
                met.set()
                raise AwsError(f'{what} failed', code='InternalError', status=500)
            return answer

        patch.setattr(Account, 'call', lost)

    def vanish(self) -> None:
        """Terminate the instances."""
        self._rig.ec2().terminate_instances(InstanceIds=self._rig.left()['instances'])


class Azure(Memory):
    """The simulated Azure."""

    fixture, name = 'azure_service', 'azure'
    options = {'vm_size': 'Standard_B2als_v2', 'region': 'westeurope'}
    more, away = {'vm_sizes': ['Standard_D2s_v5']}, 'eastus'
    #: Groups and schedules are there at once; an address stands for what is made beside it.
    steps = tuple((step, how) for step in (
        'resourcegroups', 'publicipaddresses', 'networkinterfaces', 'virtualmachines',
        'schedules')
        for how in ('refused', 'late', 'lost') if how == 'refused' or step != 'schedules'
        and (how == 'lost' or step != 'resourcegroups'))
    listing = 2

    def order(
        self, patch: pytest.MonkeyPatch, how: str, times: int, met: threading.Event,
    ) -> None:
        """Order errors of a machine's PUT."""
        from rigs.azure.service import Fault
        code, status = {
            'throttled': ('TooManyRequests', 429), 'unavailable': ('ServiceUnavailable', 503),
            'lost': ('InternalServerError', 500), 'full': ('AllocationFailed', 409),
            'quota': ('QuotaExceeded', 409)}[how]
        self.served.faults.append(_counted(Fault(
            code, status, 'PUT', 'virtualMachines', times=times, after=how == 'lost'), met))

    def heal(self) -> None:
        """Forget the faults."""
        self.served.faults.clear()

    def user_data(self, machine_id: str) -> bytes:
        """Return the machine's custom data."""
        name = machine_id.split('/')[1]
        (vm,) = [vm for vm in self.served.vms() if vm['name'] == name]
        return base64.b64decode(vm['properties']['osProfile']['customData'])

    def provider(self) -> VmProvider:
        """Return the provider."""
        from fogros2.provider.azure.provider import AzureProvider
        return AzureProvider()

    def left(self) -> bool:
        """Return whether there is a group or a machine; the role of machines stays."""
        return bool(self.served.vms() or self.served.groups)

    def calls(self) -> int:
        """Return the number of requests."""
        return len(self.served.calls)

    def hurry(self) -> None:
        """Let operations take no time."""
        self.served.delay = 0.0

    def fail(self, step: str, how: str) -> None:
        """Order an error; without the right to assign roles there is a schedule."""
        from rigs.azure import service
        self.served.rights = service.CONTRIBUTOR
        self.patch.setattr('fogros2.provider.vm.account.ATTEMPTS', 1)
        self.served.faults.append(service.Fault(
            'SomethingIsWrong', 500 if how == 'lost' else 400, 'PUT', step, times=0,
            late=how == 'late', after=how == 'lost'))

    def vanish(self) -> None:
        """Evict the machines."""
        for vm in self.served.vms():
            self.served.evict(vm['id'])


class Gcp(Memory):
    """The simulated Compute Engine."""

    fixture, name = 'gce', 'gcp'
    options = {'region': 'europe-west3', 'disk_size': 10}
    more, away = {'machine_types': ['n2-standard-2']}, 'us-central1'
    steps = tuple((step, how) for step in ('firewalls.insert', 'instances.insert')
                  for how in ('refused', 'late', 'lost'))
    listing = 1

    def open_catalogue(self) -> None:
        """Name the key that Google's catalogue takes."""
        from fogros2.provider.gcp import prices
        from rigs.gce.catalogue import API_KEY
        self.patch.setenv(prices.KEY_VARIABLE, API_KEY)
        self.patch.setenv(prices.ENDPOINT_VARIABLE, f'{self.served.url}/')

    def order(
        self, patch: pytest.MonkeyPatch, how: str, times: int, met: threading.Event,
    ) -> None:
        """Order errors of an insert; a code in capitals is that of its operation."""
        from rigs.gce.api import Fault
        code = {'throttled': 'rateLimitExceeded', 'unavailable': 'backendError',
                'lost': 'internalError', 'full': 'ZONE_RESOURCE_POOL_EXHAUSTED',
                'quota': 'QUOTA_EXCEEDED'}[how]
        self.served.api.faults.append(_counted(Fault(
            code, 'instances.insert', times=times, after=how == 'lost'), met))

    def heal(self) -> None:
        """Forget the faults."""
        self.served.api.faults.clear()

    def user_data(self, machine_id: str) -> bytes:
        """Return the metadata of the instance."""
        name = machine_id.split('/')[-2]
        (found,) = [one for one in self.served.instances if one['name'] == name]
        items = {item['key']: item['value'] for item in found['metadata']['items']}
        return base64.b64decode(items['user-data'])

    def provider(self) -> VmProvider:
        """Return the provider."""
        from fogros2.provider.gcp.provider import GCPProvider
        return GCPProvider()

    def left(self) -> bool:
        """Return whether there is an instance or a rule."""
        return bool(self.served.instances or self.served.own_firewalls)

    def calls(self) -> int:
        """Return the number of requests."""
        return len(self.served.api.calls)

    def fail(self, step: str, how: str) -> None:
        """Order an error; a code in capitals is that of an operation."""
        self.patch.setattr('fogros2.provider.vm.account.ATTEMPTS', 1)
        from rigs.gce.api import Fault
        code = {'refused': 'forbidden', 'late': 'INTERNAL_ERROR', 'lost': 'internalError'}[how]
        self.served.api.faults.append(Fault(code, step, times=0, after=how == 'lost'))

    def vanish(self) -> None:
        """End the instances."""
        for instance in self.served.instances:
            self.served.project.cloud.end(instance['id'], 'terminate')
        project = self.served.project  # which shows an instance for a while that has ended
        wait_until(lambda: not self.served.instances and not [*project._lingering('instance')],
                   timeout=60.0, what='the instances to end')


MEMORIES: Mapping[str, type[Memory]] = {one.name: one for one in (Aws, Azure, Gcp)}

