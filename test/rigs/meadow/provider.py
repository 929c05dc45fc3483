# SPDX-License-Identifier: Apache-2.0
"""The provider of Meadow, written from doc/developers/providers_vm.md."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
import dataclasses
from decimal import Decimal
import os
from typing import Any, ClassVar, Optional

from fogros2.errors import FogError, MachineNotFound, PrerequisiteError
from fogros2.model import MachineState
from fogros2.provider import Capabilities, TAG_ON_EXIT
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import Order, Place, Vm, VmCloud, VmId
from fogros2.provider.vm.failures import CodedError, Failure, unless_gone
from fogros2.provider.vm.labels import LabelRules
from fogros2.provider.vm.options import VmOptions
from fogros2.provider.vm.provider import VmProvider
from fogros2.provider.vm.regions import Regions
from fogros2.provider.vm.rest import RestAccount
from fogros2.waiting import wait_until

RULES = LabelRules(plain='a-z0-9-', longest=63)
STATES = {'pending': MachineState.PENDING, 'running': MachineState.RUNNING,
          'stopped': MachineState.STOPPED, 'deleting': MachineState.DELETED}
TABLE = {'north': (60.2, 24.9, 'Helsinki', True), 'south': (38.7, -9.1, 'Lisbon', True)}


@dataclasses.dataclass(frozen=True)
class MeadowOptions(VmOptions):
    """Options of a machine at Meadow."""

    machine_type: str = ''
    machine_types: tuple[str, ...] = ()

    WHAT: ClassVar[str] = 'a machine at Meadow'
    DEFAULT_TYPE: ClassVar[str] = 'small'
    FORMS: ClassVar[Mapping[str, tuple[str, str]]] = {
        'region': ('nearest|[a-z]+', "'north'"), 'machine_type': ('[a-z]+', "'small'")}


class MeadowError(CodedError):
    """Meadow refused."""

    TITLE = 'Meadow'
    FAILURES: ClassVar[Mapping[str, Failure]] = {
        'bad_token': Failure('Meadow does not accept the token', 'check MEADOW_TOKEN',
                             PrerequisiteError),
        'exhausted': Failure('Meadow has no free machine of this type here',
                             'name another region=', full='zone'),
        'no_such_machine': Failure(gone=True)}


class Account(RestAccount):
    """The account of MEADOW_TOKEN."""

    TITLE, ENDPOINT_VARIABLE = 'Meadow', 'MEADOW_URL'

    def token(self, what: str) -> str:
        """Return the token."""
        return os.environ.get('MEADOW_TOKEN', '')

    def refusal(self, status: int, body: Any, what: str) -> FogError:
        """Return the error for Meadow's code."""
        code = str(body.get('code', '')) if isinstance(body, dict) else ''
        return MeadowError.of(code, '', what, status)

    def call(self, what: str, method: str, path: str, body: Any = None, **query: str) -> Any:
        """Make a request, and return the JSON of its answer."""
        return self.ask(method, os.environ['MEADOW_URL'] + path, what, body, query=query).body


class Meadow(VmCloud):
    """The API of Meadow."""

    name = 'meadow'
    title = 'Meadow'
    options = MeadowOptions
    regions = Regions('Meadow', TABLE, lambda region: f'{region}.meadow.example')
    id_form = 'm-[0-9a-f]+'
    base_region = 'north'

    def __init__(self) -> None:
        self._account = Account()

    def _call(self, what: str, method: str, path: str, body: Any = None, **query: str) -> Any:
        return self._account.call(what, method, path, body, **query)

    def _path(self, region: str, vm: str = '', action: str = '') -> str:
        return '/'.join(filter(None, ['/regions', region, 'machines', vm, action]))

    def check_credentials(self) -> None:
        """Look for the token."""
        if not os.environ.get('MEADOW_TOKEN'):
            raise PrerequisiteError('there is no token of Meadow', 'set MEADOW_TOKEN')

    def whoami(self, region: str) -> str:
        """Return the account."""
        return f"account {self._call('asking for the account', 'GET', '/account')['name']}"

    def default_region(self) -> str:
        """Return the region of the environment."""
        return os.environ.get('MEADOW_REGION', '')

    def _types(self, region: str) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self._call(
            'asking for the types', 'GET', f'/regions/{region}/types')['types']
        return found

    def types(self, region: str) -> list[MachineType]:
        """Return the types."""
        return [MachineType(kind['name'], kind['vcpus'], kind['cores'], kind['memory_gb'],
                            kind['arch']) for kind in self._types(region)]

    def prices(self, region: str, name: str = '') -> dict[str, Decimal]:
        """Return the prices."""
        return {kind['name']: Decimal(kind['price']) for kind in self._types(region)
                if name in ('', kind['name'])}

    def places(self, region: str, order: Order) -> Iterator[str]:
        """Yield the zones."""
        yield from {'north': ('north-a', 'north-b'), 'south': ('south-a',)}[region]

    def _vm(self, machine: Mapping[str, Any]) -> Vm:
        return Vm(machine['id'], machine['region'], STATES[machine['state']],
                  RULES.decode(machine['labels']), kind=machine['type'],
                  address=machine['address'], created=machine['created'])

    def find(self, region: str, tags: Mapping[str, str]) -> list[Vm]:
        """Return the machines with all of the tags."""
        found = self._call('looking for machines', 'GET', self._path(region),
                           **RULES.encode(tags))['machines']
        machines = [self._vm(machine) for machine in found]
        return [vm for vm in machines if 'fogros2-attempt' in vm.tags
                and vm.state is not MachineState.DELETED]

    def get(self, region: str, vm: str) -> Optional[Vm]:
        """Return a machine."""
        with unless_gone():
            found = self._vm(self._call(f'looking for {vm}', 'GET', self._path(region, vm)))
            if found.state is not MachineState.DELETED:
                return found
        raise MachineNotFound(f'there is no {vm} in {region} any more')

    def insert(
        self, place: Place, order: Order, prepared: Any, created: Sequence[str],
        tags: Mapping[str, str],
    ) -> str:
        """Request a machine."""
        return str(self._call(
            f"creating '{order.spec.name}'", 'POST', self._path(place.region), {
                'key': order.token(place), 'type': place.kind, 'zone': place.zone,
                'user_data': base64.b64encode(order.user_data).decode(),
                'labels': RULES.encode(tags),
                'firewall': {'22/tcp': list(order.sources),
                             f'{order.request.vpn_port}/udp': ['any']},
            })['id'])

    def delete(self, machine: VmId) -> None:
        """Delete a machine, and wait until it is gone."""
        path = self._path(machine.region, machine.vm)

        def gone() -> bool:
            with unless_gone():
                self._call(f'looking for {machine.vm}', 'GET', path)
                return False
            return True

        with unless_gone():
            self._call(f'deleting {machine.vm}', 'DELETE', path)
            wait_until(gone, timeout=60.0, what=f'{machine.vm} to be deleted')

    def end_attempt(self, region: str, attempt: str) -> bool:
        """Delete the machines of an attempt."""
        found = self.find(region, {'fogros2-attempt': attempt})
        for vm in found:
            with unless_gone():
                self._call(f'deleting {vm.id}', 'DELETE', self._path(region, vm.id))
        return bool(found)

    def end_command(self, machine: VmId, tags: Mapping[str, str]) -> tuple[str, ...]:
        """Ask Meadow's metadata service, which obeys the machine: one that is off is billed."""
        action = ('POST', 'stop') if tags.get(TAG_ON_EXIT) == 'stop' else ('DELETE', '')
        return ('curl', '-fsX', action[0], f'http://169.254.169.254/machine/{action[1]}')

    def set_firewall(self, machine: VmId, port: int, sources: Sequence[str]) -> None:
        """Change the firewall."""
        self._call(f'opening port {port}', 'PUT',
                   self._path(machine.region, machine.vm, 'firewall'),
                   {f'{port}/tcp': list(sources)})

    def set_tags(self, machine: VmId, tags: Mapping[str, str]) -> None:
        """Change labels."""
        self._call(f'writing labels of {machine.vm}', 'PATCH',
                   self._path(machine.region, machine.vm, 'labels'), RULES.encode(tags))

    def stop(self, machine: VmId) -> None:
        """Stop a machine."""
        self._call(f'stopping {machine.vm}', 'POST',
                   self._path(machine.region, machine.vm, 'stop'))

    def start(self, machine: VmId) -> None:
        """Start a machine."""
        self._call(f'starting {machine.vm}', 'POST',
                   self._path(machine.region, machine.vm, 'start'))


class MeadowProvider(VmProvider):
    """Machines at Meadow."""

    name = 'meadow'
    adapter = Meadow
    capabilities: ClassVar[Capabilities] = dataclasses.replace(
        VmProvider.capabilities, stop=True)
