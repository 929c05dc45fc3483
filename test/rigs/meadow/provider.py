# SPDX-License-Identifier: Apache-2.0
"""The provider of Meadow, written from doc/developers/providers.md."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
import dataclasses
from decimal import Decimal
import json
import os
from typing import Any, ClassVar, Optional
import urllib.error
from urllib.parse import urlencode
import urllib.request

from fogros2.errors import MachineNotFound, PrerequisiteError
from fogros2.model import MachineState
from fogros2.provider import Capabilities
from fogros2.provider.offers import MachineType
from fogros2.provider.vm.cloud import CloudError, Order, Place, Vm, VmCloud, VmId
from fogros2.provider.vm.labels import LabelRules
from fogros2.provider.vm.options import VmOptions
from fogros2.provider.vm.provider import VmProvider
from fogros2.provider.vm.regions import Regions
from fogros2.waiting import cancellable, ON_ITS_WAY, wait_until

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


class Meadow(VmCloud):
    """The API of Meadow."""

    name = 'meadow'
    title = 'Meadow'
    options = MeadowOptions
    regions = Regions('Meadow', TABLE, lambda region: f'{region}.meadow.example')
    id_form = 'm-[0-9a-f]+'
    base_region = 'north'

    def _call(self, what: str, method: str, path: str, body: Any = None, **query: str) -> Any:
        """Make a request that ends when ``cancel`` is set."""
        url = os.environ['MEADOW_URL'] + path + (f'?{urlencode(query)}' if query else '')
        request = urllib.request.Request(
            url, None if body is None else json.dumps(body).encode(), method=method,
            headers={'Authorization': f'Bearer {os.environ["MEADOW_TOKEN"]}'})

        def ask() -> Any:
            with urllib.request.urlopen(request, timeout=10.0) as answer:
                return json.load(answer)

        try:
            # nobody waits for an answer that changes nothing
            return cancellable(ask, self.cancel, what=what,
                               grace=lambda: 0.0 if method == 'GET' else ON_ITS_WAY)
        except urllib.error.HTTPError as error:
            code = json.load(error)['code']
            if code == 'bad_token':
                raise PrerequisiteError('Meadow does not accept the token',
                                        'check MEADOW_TOKEN') from error
            raise CloudError(f'{what} failed: {code}', gone=code == 'no_such_machine',
                             full='zone' if code == 'exhausted' else '') from error
        except OSError as error:
            silent = PrerequisiteError(f'{what} failed: Meadow does not answer: {error}',
                                       'check MEADOW_URL')
            silent.refused = method == 'GET'
            raise silent from error

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
            'asking for the types', 'GET', f'/regions/{region}/types')
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
                           **RULES.encode(tags))
        machines = [self._vm(machine) for machine in found]
        return [vm for vm in machines if 'fogros2-attempt' in vm.tags
                and vm.state is not MachineState.DELETED]

    def get(self, region: str, vm: str) -> Optional[Vm]:
        """Return a machine."""
        try:
            found = self._vm(self._call(f'looking for {vm}', 'GET', self._path(region, vm)))
        except CloudError as error:
            if error.gone:
                raise MachineNotFound(f'there is no {vm} in {region}') from error
            raise
        if found.state is MachineState.DELETED:
            raise MachineNotFound(f'{vm} in {region} is deleted')
        return found

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

        def gone(method: str) -> bool:
            try:
                self._call(f'deleting {machine.vm}', method, path)
            except CloudError as error:
                if not error.gone:
                    raise
                return True
            return False

        if not gone('DELETE'):
            wait_until(lambda: gone('GET'), timeout=60.0, what=f'{machine.vm} to be deleted')

    def end_attempt(self, region: str, attempt: str) -> bool:
        """Delete the machines of an attempt."""
        found = self.find(region, {'fogros2-attempt': attempt})
        for vm in found:
            self._call(f'deleting {vm.id}', 'DELETE', self._path(region, vm.id))
        return bool(found)

    def set_firewall(self, machine: VmId, port: int, sources: Sequence[str]) -> None:
        """Change the firewall."""
        self._call(f'opening port {port}', 'PUT',
                   self._path(machine.region, machine.vm, 'firewall'),
                   {f'{port}/tcp': list(sources)})

    def set_tags(self, machine: VmId, tags: Mapping[str, str]) -> None:
        """Change labels."""
        self._call(f'writing labels of {machine.vm}', 'PUT',
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
