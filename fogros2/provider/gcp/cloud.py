# SPDX-License-Identifier: Apache-2.0
"""Compute Engine as a cloud of virtual machines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import copy
from decimal import Decimal
import os
from typing import Any, Optional

from fogros2.errors import ConfigurationError, MachineNotFound
from fogros2.model import MachineSpec, MachineState
from fogros2.provider import TAG_ON_EXIT
from fogros2.provider.gcp import guest, images, instances, login, prices
from fogros2.provider.gcp.account import Account, ENDPOINT_VARIABLE
from fogros2.provider.gcp.disks import GoogleDisks
from fogros2.provider.gcp.failures import GoogleError
from fogros2.provider.gcp.firewall import GoogleFirewall
from fogros2.provider.gcp.instances import path_of
from fogros2.provider.gcp.options import Options
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import (
    CloudError,
    END_TIMEOUT,
    Order,
    own_name,
    Place,
    PRICES_AGE,
    TAG_ATTEMPT,
    Vm,
    VmId,
)
from fogros2.provider.vm.failures import unless_gone, wait_through
from fogros2.provider.vm.regions import read_table, Regions
from fogros2.waiting import cancellable

#: The region of FogROS2's default zone.
DEFAULT_REGION = 'us-central1'


class ComputeEngine(images.GoogleImages, GoogleFirewall, GoogleDisks):
    """
    Compute Engine instances, each with its own firewall rules.

    :param account: None for the account of this computer's user.
    """

    name = 'gcp'
    title = 'Google Cloud'
    options = Options
    regions = Regions('Google Cloud', read_table(__file__),
                      lambda region: f'compute.{region}.rep.googleapis.com')
    #: Project, zone and name.
    id_form = r'[a-z0-9.:-]+/[a-z0-9-]+/fogros2-[0-9a-f]{16}'
    base_region = DEFAULT_REGION
    types_age = PRICES_AGE
    boot = guest.BOOT
    configured = staticmethod(login.configured)

    def __init__(self, account: Optional[Account] = None) -> None:
        self._account: Account = account or Account()
        #: GPUs to attach, for the price.
        self._gpus: Mapping[str, int] = {}

    # -- the account ----------------------------------------------------------------------------

    def account(self, options: Any) -> ComputeEngine:
        """Return an adapter for the project and the GPUs that options name."""
        other = copy.copy(self)
        other._account = self._account.of_project(options.project_id)
        other._gpus = {gpu['acceleratorType']: gpu['acceleratorCount'] for gpu in options.gpus()}
        return other

    def check_credentials(self) -> None:
        self._account.check()

    def whoami(self, region: str) -> str:
        project = self._account.project
        self._account.call('GET', project, f"asking Google for the project '{project}'")
        return f'project {project}, {region}'

    def default_region(self) -> str:
        """Return the region of gcloud's variables, else the one of FogROS2."""
        zone = os.environ.get('CLOUDSDK_COMPUTE_ZONE', '')
        return os.environ.get('CLOUDSDK_COMPUTE_REGION', '') or zone[:-2] or DEFAULT_REGION

    def searched_regions(self) -> list[str]:
        return ['']

    # -- types and prices -----------------------------------------------------------------------

    def account_key(self) -> str:
        return f'{self._account.project}|{os.environ.get(ENDPOINT_VARIABLE, "")}|{self._gpus}'

    def _types(self, region: str, names: Sequence[str]) -> list[Mapping[str, Any]]:
        """Return the types of every zone of a region; all types if none is named."""
        kinds = ' OR '.join(f'(name = "{name}")' for name in names)
        zones = ' OR '.join(f'(zone = "{region}-{letter}")' for letter in 'abcdef')
        project = self._account.project
        return self._account.once(' '.join((project, region, *names)), lambda: list(
            self._account.pages(
                f'{project}/aggregated/machineTypes', 'asking for the machine types',
                maxResults='500', filter=f'({kinds}) AND ({zones})' if names else f'({zones})')))

    def types(self, region: str) -> list[MachineType]:
        entries = {entry['name']: entry for entry in self._types(region, ())}
        return [instances.machine_type(entry) for entry in entries.values()]

    def zones(self, region: str) -> dict[str, list[str]]:
        zones: dict[str, list[str]] = {}
        for entry in self._types(region, ()):
            zones.setdefault(entry['name'], []).append(entry['zone'])
        return zones

    def _priced(self, region: str, names: Sequence[str], spot: bool) -> dict[str, Decimal]:
        rates = cancellable(prices.rates, self.cancel, what="asking for Google's prices",
                            grace=lambda: 0.0)
        costs = {entry['name']: prices.price(rates, region, entry, self._gpus, spot)
                 for entry in self._types(region, names)}
        return {name: cost for name, cost in costs.items() if cost is not None}

    def prices(self, region: str, name: str = '') -> dict[str, Decimal]:
        return self._priced(region, (name,) if name else (), False)

    def spot_prices(
        self, region: str, names: Optional[Sequence[str]],
    ) -> dict[str, dict[str, Decimal]]:
        """Return the spot prices, which are the same in all zones of a region."""
        zones = self.zones(region)
        return {name: dict.fromkeys(zones[name], cost)
                for name, cost in self._priced(region, (), True).items()
                if names is None or name in names}

    def named_types(self, region: str, names: Sequence[str]) -> list[MachineType]:
        return [instances.machine_type(entry) for entry in self._types(region, names)]

    # -- machines -------------------------------------------------------------------------------

    def _instances(self, tags: Mapping[str, str]) -> list[Vm]:
        project = self._account.project
        return [instances.vm_of(project, entry) for entry in self._account.pages(
            f'{project}/aggregated/instances', 'looking for machines',
            filter=instances.label_filter(tags))]

    def find(self, region: str, tags: Mapping[str, str]) -> list[Vm]:
        return [vm for vm in self._instances(tags)
                if region in ('', vm.region) and vm.state is not MachineState.DELETED
                # one that is being deleted looks like one that is being stopped
                and (vm.state is not MachineState.STOPPING or vm.tags.get(TAG_ON_EXIT) == 'stop')]

    def get(self, region: str, vm: str) -> Optional[Vm]:
        project = vm.partition('/')[0]
        entry: Mapping[str, Any] = {}
        with unless_gone():
            entry = self._account.call('GET', path_of(vm), f'looking for {vm}')
        if not entry:
            raise MachineNotFound(f'there is no {vm} any more')
        self._account.labels[vm] = entry['labelFingerprint'], entry.get('labels', {})
        machine = instances.vm_of(project, entry)
        if machine.state is MachineState.DELETED:
            raise MachineNotFound(f'{vm} has ended')
        return machine

    def prepare(self, region: str, order: Order, types: Sequence[str]) -> dict[str, Any]:
        """Return the zones and the image of each type."""
        options: Options = order.options
        zone = order.zone or options.zone
        chosen: dict[str, Any] = {}
        for entry in self._types(region, types):
            kind = instances.machine_type(entry)
            if entry['zone'] == (zone or entry['zone']):
                chosen.setdefault(kind.name, {
                    'arch': kind.arch, 'gpus': bool(kind.gpus or options.accelerators),
                    'zones': []})['zones'].append(entry['zone'])
        if not chosen:
            raise ConfigurationError(
                f'{zone or region} has no machine type {" or ".join(types)}',
                'gcloud compute machine-types list shows what it has')
        chosen_images: dict[Any, tuple[str, int]] = {}
        for entry in chosen.values():
            key = entry['arch'], entry['gpus']
            if key not in chosen_images:
                chosen_images[key] = self.image_for(options, *key, order.request.dependencies)
            entry['path'], entry['size'] = chosen_images[key]
        return {kind: chosen[kind] for kind in types if kind in chosen}

    def places(self, region: str, order: Order) -> Iterator[str]:
        types = self._types(region, order.options.types)
        zone = order.zone or order.options.zone
        yield from [zone] if zone else sorted(
            {str(entry['zone']) for entry in types})

    def insert(
        self, place: Place, order: Order, prepared: Any, created: Sequence[str],
        tags: Mapping[str, str],
    ) -> str:
        """Request an instance, and wait until Google has found capacity for it."""
        if place.zone not in prepared['zones']:
            raise CloudError(f'{place.zone} has no machine type {place.kind}', full='zone')
        name, project = own_name(order.attempt), self._account.project
        self._account.create(
            f'{project}/zones/{place.zone}/instances',
            f"creating '{order.spec.name}' ({place.kind} in {place.zone})",
            instances.insertion(place, order, prepared, self._subnet(place, order), tags),
            requestId=order.token(place))
        return f'{project}/{place.zone}/{name}'

    def _subnet(self, place: Place, order: Order) -> str:
        """Return the subnetwork of a network that the user has named."""
        name = order.options.network
        if name == 'default':
            return ''
        network = self._account.call(
            'GET', f'{self._account.project}/global/networks/{name}',
            f"looking for the network '{name}'")
        return next((str(url) for url in network.get('subnetworks', ())
                     if f'/regions/{place.region}/' in url), '')

    def end_command(self, machine: VmId, tags: Mapping[str, str]) -> tuple[str, ...]:
        return super().end_command(machine, tags) if tags.get(TAG_ON_EXIT) == 'stop' \
            else (*guest.DELETE, self._account.endpoint)

    def delete(self, machine: VmId) -> None:
        """Delete an instance with its disk, then its firewall rules."""
        self._account.remove(path_of(machine.vm), f'deleting {machine.vm}')
        self._account.labels.pop(machine.vm, None)
        self._drop_rules(machine.vm.partition('/')[0], machine.attempt)

    def end_attempt(self, region: str, attempt: str) -> bool:
        vms = self._instances({TAG_ATTEMPT: attempt})
        for vm in vms:
            self._account.remove(path_of(vm.id), f'deleting {vm.id}')
        return bool(vms)

    def sweep(self, region: str, attempt: str) -> None:
        """Delete an instance that ended itself, and the firewall rules."""
        self.end_attempt(region, attempt)
        self._drop_rules(self._account.project, attempt)

    def attempts(self, region: str) -> list[str]:
        # of one that ended itself, a stopped disk is all that is left
        return [vm.tags.get(TAG_ATTEMPT, '') for vm in self._instances({})
                if vm.state is not MachineState.DELETED]

    def set_tags(self, machine: VmId, tags: Mapping[str, str]) -> None:
        """Replace labels, which Google takes only as a whole and with their fingerprint."""
        for again in (True, False):
            if machine.vm not in self._account.labels:
                self.get(machine.region, machine.vm)
            fingerprint, labels = self._account.labels.pop(machine.vm)
            kept = {key: value for key, value in labels.items()
                    if not any(key == tag or key.startswith(f'{tag}_') for tag in tags)}
            try:
                self._account.run(
                    'POST', f'{path_of(machine.vm)}/setLabels',
                    f'writing labels of {machine.vm}', body={
                        'labelFingerprint': fingerprint,
                        'labels': {**kept, **instances.RULES.encode(tags)}})
                return
            except GoogleError as error:
                if error.code != 'CONDITION_NOT_MET' or not again:
                    raise

    def set_ending(self, machine: VmId, spec: MachineSpec) -> None:
        """Change when Google ends an instance, which it takes for stopped instances only."""
        path, what = path_of(machine.vm), f'writing how {machine.vm} ends'
        instance = wait_through(
            lambda: state if (state := self._account.call('GET', path, what))['status']
            not in ('PENDING_STOP', 'STOPPING') else None,
            timeout=END_TIMEOUT, interval=1.0, longest=5.0, what=f'{machine.vm} to be stopped')
        words = {key: value for key, value in instance['scheduling'].items()
                 if key not in ('maxRunDuration', 'instanceTerminationAction')}
        if instance['status'] == 'TERMINATED':
            # stopped, with the action of a machine that is deleted, would mean that it has ended
            words.update(instances.limit(spec, spot=False, action='STOP'))
            self._account.run('POST', f'{path}/setScheduling', what, body=words)

    def stop(self, machine: VmId) -> None:
        self._account.call('POST', f'{path_of(machine.vm)}/stop', f'stopping {machine.vm}')

    def start(self, machine: VmId) -> None:
        self._account.run('POST', f'{path_of(machine.vm)}/start', f'starting {machine.vm}')
