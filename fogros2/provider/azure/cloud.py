# SPDX-License-Identifier: Apache-2.0
"""
Azure as a cloud of virtual machines.

Each machine has a resource group of its own, with the same name, so that one deletion takes
everything. FogROS2 deletes only groups with its own tags. All names come from the idempotency
token, and a repeated PUT of the same name creates nothing more.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import contextlib
from decimal import Decimal
import os
import time
from typing import Any, Optional

from fogros2.errors import ConfigurationError, FogError, MachineNotFound, ProviderError
from fogros2.model import MachineSpec, MachineState
from fogros2.provider.azure import ending, login, machines, prices
from fogros2.provider.azure.account import Account, endpoint, subscription
from fogros2.provider.azure.disks import AzureDisks
from fogros2.provider.azure.failures import AzureError, refusal
from fogros2.provider.azure.images import AzureImages
from fogros2.provider.azure.machines import Prepared
from fogros2.provider.azure.options import OLD_UBUNTU, Options
from fogros2.provider.vm.cloud import (
    Order,
    own_name,
    Place,
    PRICES_AGE,
    TAG_ATTEMPT,
    TAG_MADE,
    TAG_PRICE,
    TAG_SSH_FROM,
    Vm,
    VmId,
)
from fogros2.provider.vm.failures import settled, unless_gone, wait_through
from fogros2.provider.vm.options import ipv4, SSH
from fogros2.provider.vm.regions import read_table, Regions

_VMS = 'providers/Microsoft.Compute/virtualMachines'
_NET = 'providers/Microsoft.Network'
#: The region of pull request 109.
OLD_REGION = 'eastus'
#: Seconds in which Azure finds room for a machine, or says that there is none.
ALLOCATION = 300.0
#: The code of a group that Azure does not know everywhere yet.
_NEW_GROUP = ('ResourceGroupNotFound',)
#: One for all providers of this process, so that its sizes are asked for once.
_USUAL = Account()


class Azure(AzureImages, AzureDisks):
    """
    Virtual machines of Azure.

    :param account: None for the account of this computer's user.
    """

    name = 'azure'
    title = 'Azure'
    options = Options
    regions = Regions('Azure', read_table(__file__),
                      lambda region: f'{region}.handler.control.monitor.azure.com')
    id_form = 'fogros2-[0-9a-f]{16}-[0-9a-f]{8}'
    base_region = 'westeurope'
    types_age = PRICES_AGE
    configured = staticmethod(login.configured)

    def __init__(self, account: Optional[Account] = None) -> None:
        self._account = account or _USUAL

    # -- the account ----------------------------------------------------------------------------

    def check_credentials(self) -> None:
        subscription()
        self._account.credential()

    def whoami(self, region: str) -> str:
        answer = self._account.having(None, hasty=True).call(
            'GET', self._account.path(), 'asking Azure for the subscription')
        return f'subscription {answer["displayName"]}, {region}'

    def default_region(self) -> str:
        """Return the region that the user's environment names for the az command."""
        named = os.environ.get('AZURE_DEFAULTS_LOCATION') or OLD_REGION
        return named.lower().replace(' ', '')  # 'West Europe', too

    def searched_regions(self) -> list[str]:
        return ['']

    # -- machines -------------------------------------------------------------------------------

    def _all(self, region: str) -> list[Mapping[str, Any]]:
        """Return the entries of FogROS2's machines that are not being deleted."""
        return [entry for entry in self._account.pages(
                    self._account.path(rest=_VMS), 'looking for machines')
                if TAG_ATTEMPT in (entry.get('tags') or {}) and prices.is_in(entry, region)
                and entry['properties'].get('provisioningState') != 'Deleting']

    def find(self, region: str, tags: Mapping[str, str]) -> list[Vm]:
        """Return the machines with all of ``tags``; a second request for their states."""
        entries = [entry for entry in self._all(region) if tags.items() <= entry['tags'].items()]
        if not entries:
            return []
        states = {str(entry['id']).lower(): entry['properties'].get('instanceView', {}).get(
                      'statuses') or () for entry in self._account.pages(
                          self._account.path(rest=_VMS), 'looking for the states of machines',
                          statusOnly='true')}
        return [machines.vm_of(entry, states.get(str(entry['id']).lower(), ()))
                for entry in entries]

    def get(self, region: str, vm: str) -> Optional[Vm]:
        # what insert has just seen is reported once
        entry = self._account.seen.pop(vm, {})
        with unless_gone():
            entry = entry or self._entry(vm)
        if not entry:
            raise MachineNotFound(f'there is no {vm} in {region} any more')
        machine = machines.vm_of(entry)
        if machine.state is MachineState.DELETED:
            raise MachineNotFound(f'{vm} in {region} is being deleted')
        return machine

    def prepare(self, region: str, order: Order, types: Sequence[str]) -> dict[str, Prepared]:
        """Return image, disk and network of each size that the region has."""
        options: Options = order.options
        with ThreadPoolExecutor(3, 'fog-azure') as pool:
            listing = pool.submit(self.sizes, region)
            guarded = pool.submit(ending.may_assign, self._account)
            subnet = pool.submit(self._subnet, options.resource_group, region)
            baked = pool.submit(self.baked, region, options, order.request.dependencies)
            sizes = {name: entry for name in types if (entry := listing.result().get(name))
                     and (not options.spot or prices.machine_type(entry).spot)}
            if not sizes:
                raise ConfigurationError(
                    f'Azure has no {" or ".join(types)} in {region} for this subscription'
                    + ' as a spot machine' * options.spot,
                    'ros2 fog price --region shows what it has; confidential sizes need settings '
                    'that FogROS2 does not make')
            prepared = {}
            for name, entry in sizes.items():
                kind, version = prices.machine_type(entry), prices.generation(entry)
                image, disk = baked.result().get((kind.arch, version)) or (
                    options.image,
                    machines.UBUNTU_DISK if options.image in ('', OLD_UBUNTU) else 0)
                prepared[name] = Prepared(
                    machines.image_of(image, kind.arch, version), disk,
                    kind.gpu.startswith('NVIDIA'),
                    prices.capabilities(entry).get('PremiumIO') == 'True',
                    subnet.result(), guarded.result())
            return prepared

    def _subnet(self, group: str, region: str) -> str:
        """Return a subnet of the user's own group in a region, '' if there is none."""
        networks: list[Mapping[str, Any]] = []
        with unless_gone():  # pull request 109 creates the group
            networks += self._account.pages(
                self._account.path(group, f'{_NET}/virtualNetworks'),
                f'looking for a network in {group}') if group else ()
        return next((str(subnet['id']) for network in networks if prices.is_in(network, region)
                     for subnet in network['properties'].get('subnets') or ()
                     if not subnet['properties'].get('delegations')), '')

    def undo_begin(
        self, region: str, attempt: str, created: Sequence[str],
    ) -> Iterator[tuple[str, Callable[[], object]]]:
        yield 'the resource group', lambda: self._drop(attempt, created)

    def insert(
        self, place: Place, order: Order, prepared: Prepared, created: list[str],
        tags: Mapping[str, str],
    ) -> str:
        """Create a group with a network and a machine; without room, delete it again."""
        name = machines.name_of(order, place)
        created.append(name)
        try:
            self._account.call(
                'PUT', self._account.path(name), f"making the group of '{order.spec.name}'",
                {'location': place.region,
                 'tags': {**order.tags, TAG_MADE: str(int(time.time()))}})
            self._insert(name, place, order, prepared, tags)
        except FogError as error:
            # the next place has a group of its own; what stays is undone at the end, or by gc
            with contextlib.suppress(FogError):
                self.until(None)._drop(order.attempt, [name], empty=[name])
                error.refused = True  # Azure creates nothing in a group that it deletes
            raise
        return name

    def _insert(
        self, name: str, place: Place, order: Order, prepared: Prepared, tags: Mapping[str, str],
    ) -> None:
        common = {'location': place.region, 'tags': dict(order.tags)}

        def put(kind: str, properties: Mapping[str, Any], **more: Any) -> Mapping[str, Any]:
            what = f"making the {kind} of '{order.spec.name}'"
            resource: Mapping[str, Any] = settled(
                lambda: self._account.call(
                    'PUT', self._account.path(name, f'{_NET}/{kind}/{name}'), what,
                    {**common, **more, 'properties': properties}, wait=True),
                *_NEW_GROUP, what=what)
            return resource

        with ThreadPoolExecutor(3, 'fog-azure') as pool:
            firewall = pool.submit(put, 'networkSecurityGroups', machines.firewall(order))
            address = pool.submit(put, 'publicIPAddresses', {
                'publicIPAllocationMethod': 'Static', 'publicIPAddressVersion': 'IPv4'},
                sku={'name': 'Standard'})
            network = None if prepared.subnet else pool.submit(put, 'virtualNetworks', {
                'addressSpace': {'addressPrefixes': ['10.0.0.0/28']},
                'subnets': [{'name': 'machine', 'properties': {
                    'addressPrefix': '10.0.0.0/28', 'defaultOutboundAccess': False}}]})
            subnet = prepared.subnet if network is None else str(
                network.result()['properties']['subnets'][0]['id'])
            public = address.result()
            self._account.admitted[order.attempt] = ipv4(order.sources)
            nic = put('networkInterfaces', {
                'networkSecurityGroup': {'id': firewall.result()['id']},
                'ipConfigurations': [{'name': 'machine', 'properties': {
                    'primary': True, 'privateIPAllocationMethod': 'Dynamic',
                    'subnet': {'id': subnet}, 'publicIPAddress': {'id': public['id']}}}]})
        tags = {**tags, machines.TAG_ADDRESS: str(public['properties']['ipAddress'])}
        if prepared.subnet:
            private = nic['properties']['ipConfigurations'][0]['properties']['privateIPAddress']
            # machines of one network reach each other; its name is long
            tags[machines.TAG_PRIVATE] = f'{private} {"/".join(subnet.split("/")[4:9:2])}'
        what = f"creating '{order.spec.name}' ({place.kind})"
        body = machines.request(place, order, prepared, str(nic['id']), tags)
        made = settled(
            lambda: self._account.call('PUT', self._account.vm(name), what, body), *_NEW_GROUP,
            what=what)
        guarded = False
        # at once: the robot may vanish while Azure looks for room
        if made.get('identity') or not prepared.guarded:
            with contextlib.suppress(AzureError):
                self._guard(name, place.region, order, prepared, made)
                guarded = True
        entry = self._account.seen[name] = self._allocated(name, what)
        if not guarded:
            self._guard(name, place.region, order, prepared, entry)
        if prepared.nvidia:
            self._install_driver(name, place.region)

    def _allocated(self, name: str, what: str) -> Mapping[str, Any]:
        """Wait until a new machine has its computer; raise the error that comes late."""
        def look() -> Optional[Mapping[str, Any]]:
            entry = self._entry(name)
            codes = []
            for status in entry['properties'].get('instanceView', {}).get('statuses') or ():
                codes.append(code := str(status.get('code', '')))
                if code.startswith('ProvisioningState/failed'):
                    raise refusal(400, {**status, 'code': code.split('/')[-1]}, what)
            return entry if any(code.startswith('PowerState/') for code in codes) else None

        return wait_through(look, timeout=ALLOCATION, cancel=self.cancel, first=0.3,
                            interval=1.0, longest=4.0, what=what)

    def _guard(
        self, name: str, region: str, order: Order, prepared: Prepared, entry: Mapping[str, Any],
    ) -> None:
        """Let the machine end its own billing, or let Azure do it at a time of day."""
        principal = str(entry.get('identity', {}).get('principalId', ''))
        if prepared.guarded and principal and ending.assign(self._account, name, principal):
            return
        first = ending.schedule(self._account, name, region, order.spec.lifetime)
        seconds = int(first - self._account.clock.now())
        price = Decimal(entry['tags'].get(TAG_PRICE, 0)) * seconds / 3600
        worst = f', at most ${price:.2f}' if price else ''
        self.notes[name] = [
            'if this robot vanishes, the machine powers itself off and is billed until Azure '
            f'deallocates it at {time.strftime("%H:%M UTC", time.gmtime(first))}{worst} '
            '(doc/azure.md)']

    def _install_driver(self, name: str, region: str) -> None:
        """Install NVIDIA's driver on a machine that runs, without waiting."""
        wait_through(
            lambda: self._entry(name)['properties']['provisioningState'] == 'Succeeded',
            timeout=600.0, cancel=self.cancel, interval=3.0, longest=10.0, what=f'{name} to run')
        self._account.call(
            'PUT', self._account.vm(name, '/extensions/NvidiaGpuDriverLinux'),
            f"installing NVIDIA's driver on {name}", {'location': region, 'properties': {
                'publisher': 'Microsoft.HpcCompute', 'type': 'NvidiaGpuDriverLinux',
                'typeHandlerVersion': '1.9', 'autoUpgradeMinorVersion': True}})

    # -- its end --------------------------------------------------------------------------------

    def _groups(self, attempt: str = '') -> list[Mapping[str, Any]]:
        """Return the groups of FogROS2's machines, of one attempt if it is named."""
        query = f"tagName eq '{TAG_ATTEMPT}'" + f" and tagValue eq '{attempt}'" * bool(attempt)
        # a tag alone may have been copied to a group of the user's
        return [group for group in self._account.pages(
                    self._account.path(rest='resourceGroups'), 'looking for groups of machines',
                    **{'$filter': query})
                if (tag := (group.get('tags') or {}).get(TAG_ATTEMPT, ''))
                and attempt in ('', tag) and str(group['name']).startswith(own_name(tag))]

    def _drop(
        self, attempt: str, names: Iterable[str] = (), *, wait: bool = False,
        empty: Optional[Collection[str]] = None,
    ) -> bool:
        """
        Delete the groups of an attempt with everything in them; return whether there were any.

        :param names: groups that a list may not have yet.
        :param empty: only these of the groups.
        :raises ProviderError: a group of this name is not FogROS2's, and stays.
        """
        listed = {str(group['name']) for group in self._groups(attempt)}

        def drop(name: str) -> None:
            path = self._account.path(name)
            with unless_gone():
                tags = {} if name in listed else self._account.call(
                    'GET', path, f'looking for the group {name}').get('tags') or {}
                if name not in listed and tags.get(TAG_ATTEMPT) != attempt:
                    raise ProviderError(f'the group {name} has no tag of FogROS2, and stays',
                                        'FogROS2 deletes only groups that it created')
                self._account.delete(
                    path, f'deleting the group {name}', wait=wait,
                    query={'forceDeletionTypes': 'Microsoft.Compute/virtualMachines'})

        chosen = sorted(name for name in {*names, *listed} if empty is None or name in empty)
        with ThreadPoolExecutor(max(1, min(8, len(chosen))), 'fog-azure') as pool:
            list(pool.map(drop, chosen))
        return bool(chosen)

    def delete(self, machine: VmId) -> None:
        self._account.seen.pop(machine.vm, None)
        self._drop(machine.attempt, [machine.vm], wait=True)

    def end_attempt(self, region: str, attempt: str) -> bool:
        return self._drop(attempt)

    def remains(self, region: str) -> list[Mapping[str, str]]:
        """Return the tags of the groups in which no machine is left, as after an eviction."""
        return [group['tags'] for group in self._empty(region)]

    def _empty(self, region: str) -> list[Mapping[str, Any]]:
        groups = {str(entry['id']).split('/')[4].lower() for entry in self._all('')}
        return [group for group in self._groups() if prices.is_in(group, region)
                and str(group['name']).lower() not in groups]

    def sweep(self, region: str, attempt: str) -> None:
        """Delete the groups of an attempt that have no machine."""
        self._drop(attempt, empty=[str(group['name']) for group in self._empty(region)])

    # -- changes of a machine -------------------------------------------------------------------

    def set_firewall(self, machine: VmId, port: int, sources: Sequence[str]) -> None:
        if port == SSH and self._account.admits(machine.attempt, ipv4(sources)):
            return
        what, name = f'changing port {port} of {machine.vm}', machine.vm
        path = self._account.path(
            name, f'{_NET}/networkSecurityGroups/{name}/securityRules/tcp-{port}')
        if not ipv4(sources):
            self._account.delete(path, what, wait=True)
            return
        if port == SSH:
            tags = self._account.call('GET', self._account.path(name), what).get('tags') or {}
            sources = [*sources, *tags.get(TAG_SSH_FROM, '').split()]
        self._account.call('PUT', path, what, machines.open_port(port, sources), wait=True)

    def set_tags(self, machine: VmId, tags: Mapping[str, str]) -> None:
        self._account.call(
            'PATCH', self._account.vm(machine.vm, '/providers/Microsoft.Resources/tags/default'),
            f'writing tags of {machine.vm}',
            {'operation': 'Merge', 'properties': {'tags': dict(tags)}}, wait=True)

    def set_ending(self, machine: VmId, spec: MachineSpec) -> None:
        """Set the schedule of an adopted machine anew, if it has one; the tags say the rest."""
        path = self._account.path(machine.vm, 'providers/Microsoft.DevTestLab/schedules')
        if any(True for _ in self._account.pages(path, f'looking how {machine.vm} ends')):
            ending.schedule(self._account, machine.vm, machine.region, spec.lifetime)

    def stop(self, machine: VmId) -> None:
        self._account.seen.pop(machine.vm, None)
        self._account.call('POST', self._account.vm(machine.vm, '/deallocate'),
                           f'stopping {machine.vm}')

    def start(self, machine: VmId) -> None:
        self._account.call('POST', self._account.vm(machine.vm, '/start'),
                           f'starting {machine.vm}', wait=True)

    def end_command(self, machine: VmId, tags: Mapping[str, str]) -> tuple[str, ...]:
        return (*ending.END, endpoint())
