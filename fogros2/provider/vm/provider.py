# SPDX-License-Identifier: Apache-2.0
"""The Provider of a cloud of virtual machines, on top of the cloud's adapter."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import contextlib
import dataclasses
from decimal import Decimal, InvalidOperation
import functools
import os
import re
import threading
import time
from typing import Any, ClassVar, Optional, TypeVar

from fogros2 import plugin_system, untrusted
from fogros2.errors import (
    ConfigurationError,
    FogError,
    MachineNotFound,
    NameTaken,
    ProviderError,
    Unsupported,
)
from fogros2.model import (
    CreateRequest,
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
)
from fogros2.provider import Capabilities, Provider, TAG_NAME
from fogros2.provider.machine_types import Region
from fogros2.provider.vm.address import RobotAddress
from fogros2.provider.vm.cloud import (
    attempt_of,
    CloudError,
    Disk,
    END_TIMEOUT,
    TAG_ATTEMPT,
    TAG_DISK,
    TAG_HOST_KEY,
    TAG_PRICE,
    TAG_USER,
    Vm,
    VmCloud,
    VmId,
)
from fogros2.provider.vm.creation import Creation
from fogros2.provider.vm.failures import wait_through
from fogros2.provider.vm.options import ipv4, NEAREST, VmOptions
from fogros2.provider.vm.user_data import AGENT_DIRECTORY, AGENT_PROGRAM
from fogros2.waiting import cancellable

T = TypeVar('T')

#: One for all providers of this process: each machine of a launch would ask again.
_ROBOT_ADDRESS = RobotAddress()
ALL = 'all'
#: Number of regions that are asked at the same time.
PARALLEL = 20
#: The name of an attempt, see ``attempt_of``.
ATTEMPT = re.compile('[0-9a-f]{16}')
#: After the type of a spot machine, for people.
_SPOT = ' spot'


class VmProvider(Provider):
    """
    Virtual machines of one cloud.

    :param cloud: None for an adapter with the account of this computer's user.
    """

    #: The class of the adapter.
    adapter: ClassVar[type[VmCloud]]
    capabilities: ClassVar[Capabilities] = Capabilities(
        firewall=True, one_time_host_key=True, choices=True, adopt=True, regions=True,
        agent_directory=AGENT_DIRECTORY, agent_program=AGENT_PROGRAM, agent_sent=True)

    def __init__(self, cloud: Optional[VmCloud] = None) -> None:
        # its calls are not cancelled
        self.cloud = cloud or self.adapter()
        self._searched: tuple[str, ...] = ()

    @classmethod
    def configured(cls) -> bool:
        return cls.adapter.configured()

    @classmethod
    def region_names(cls) -> Sequence[str]:
        return tuple(cls.adapter.regions.table)

    def _cancel(self) -> Optional[threading.Event]:
        """Return what ends a call together with the launch; later calls are clean-up."""
        return None if self.cancel is None or self.cancel.is_set() else self.cancel

    def until(self) -> VmCloud:
        """Return the adapter, whose calls end with the launch; clean-up goes on after it."""
        return self.cloud.until(self._cancel())

    # -- before a machine exists ----------------------------------------------------------------

    def answers(self) -> str:
        return self.cloud.whoami(self._base())

    def check(self, spec: MachineSpec) -> None:
        options = self.cloud.options.of(spec)
        if options.fleet and not ipv4(options.ssh_from):
            raise ConfigurationError('fleet= needs the networks (IPv4) of its robots',
                                     "ssh_from=['198.51.100.0/24'] names one")
        self.cloud.account(options).check_credentials()
        region = self._region(options)
        for one in (*((region,) if region != NEAREST else ()), *options.regions):
            options.in_region(one)

    def ssh_networks(self, spec: MachineSpec) -> Sequence[str]:
        named = spec.options.get('ssh_from') or ()
        if not spec.options.get('fleet'):
            return ()
        return (named,) if isinstance(named, str) else tuple(named)

    def resolve(self, spec: MachineSpec) -> MachineSpec:
        options = self.cloud.options.of(spec)
        chosen: dict[str, Any] = {}
        region = self._region(options)
        if region == NEAREST:
            among = options.common_regions()
            region = self.nearest(among or ())
            if not options.regions and not options.named_image:
                chosen['regions'] = [one for one in self.cloud.regions.neighbours(region)
                                     if among is None or one in among]
        options = options.in_region(region)
        kind, cloud = options.named_type, self.cloud.account(options).until(self.cancel)
        if options.chooses_type:
            kind, *others = _market(cloud).kinds(region, options)
            # if there is no capacity for the cheapest, the next cheapest are tried
            chosen[options.TYPES] = list(options.further_types) or others[:2]
        kind = kind or options.DEFAULT_TYPE
        if options.max_price is not None and not options.chooses_type:
            _market(cloud).check(region, kind, options)
        # a mapping stays: the launch may continue in another region
        if not isinstance(spec.options.get(options.TYPE), Mapping):
            chosen[options.TYPE] = kind
        return dataclasses.replace(spec, options={**spec.options, **chosen, 'region': region})

    def choices(self, spec: MachineSpec, chosen: MachineSpec) -> list[str]:
        """Describe type and region, and what is tried if there is no capacity."""
        options = self.cloud.options.parse(chosen.options)
        options = options.in_region(options.region)
        kinds = [kind for kind in options.further_types if kind != options.named_type]
        more = [' or '.join(kinds), *([f'in {" or ".join(options.regions)}']
                                      if options.regions else [])]
        return [f'{options.named_type} in {options.region}',
                *([f'without room there {", ".join(filter(None, more))}'] if any(more) else [])]

    def architecture(self, spec: MachineSpec) -> str:
        options = self.cloud.options.parse(spec.options)
        region = self._region(options)
        arches = {kind.arch for kind in self.cloud.account(options).named_types(
            region, options.in_region(region).types)}
        arch = arches.pop() if len(arches) == 1 else ''
        return 'aarch64' if arch == 'arm64' else arch

    def cost_per_hour(self, spec: MachineSpec) -> Optional[Decimal]:
        """Return the price of a machine; its disk and traffic cost extra."""
        options = self.cloud.options.parse(spec.options)
        region = self._region(options)
        if region == NEAREST:
            return None
        options = options.in_region(region)
        return None if options.chooses_type else self._price(
            region, options.types[0], options, self.cancel)

    def _price(
        self, region: str, kind: str, options: VmOptions, cancel: Optional[threading.Event],
    ) -> Optional[Decimal]:
        with contextlib.suppress(FogError):
            price: Decimal = _market(self.cloud.account(options).until(
                cancel, hasty=True)).cost_of(region, kind, options)
            return price
        return None

    # -- a machine's life -----------------------------------------------------------------------

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        cancel, options = self.cancel, self.cloud.options.of(spec)
        cloud = self.cloud.account(options)
        regions = list(dict.fromkeys([self._region(options), *options.regions]))
        zone = ''
        if request.with_volumes:
            regions, zone = _beside(cloud.until(cancel), regions, request.with_volumes)
        creation = Creation(
            cloud.until(cancel), cloud, spec, request, options,
            sources=lambda: _ROBOT_ADDRESS.with_ipv6([self._address(cancel)]),
            price=functools.cache(
                lambda region, kind: self._price(region, kind, options, cancel)), zone=zone)
        machine = creation.run(regions)
        cloud.notes[machine.vm] += map(str, creation.undo_failures)
        return self._text(machine)

    def adopt(self, machine_id: str, spec: MachineSpec, tags: Mapping[str, str]) -> None:
        machine, cloud = self.vm_id(machine_id), self.until()
        cloud.set_tags(machine, tags)
        cloud.set_ending(machine, spec)

    def describe(self, machine_id: str) -> Machine:
        machine = self.vm_id(machine_id)
        vm = self.until().get(machine.region, machine.vm)
        if vm is None:
            return Machine(machine_id, '', self.name, MachineState.PENDING, region=machine.region)
        return dataclasses.replace(self.machine_of(vm), id=machine_id)

    def machine_of(self, vm: Vm) -> Machine:
        """
        Convert the cloud's report of a machine.

        Everybody with rights in the cloud's account can write tags, from which some clouds know
        the addresses. So a value without the form of one counts as missing.
        """
        tags, running = vm.tags, vm.state is MachineState.RUNNING
        user, key = tags.get(TAG_USER, 'ubuntu'), tags.get(TAG_HOST_KEY, '')
        address, private_ip = _ip(vm.address), _ip(vm.private_ip)
        endpoint = Endpoint('ssh', address, user=user, host_key=key) if running and address \
            and untrusted.NAME.fullmatch(user) and untrusted.HOST_KEY.fullmatch(key) else None
        disk, attempt = tags.get(TAG_DISK, ''), tags.get(TAG_ATTEMPT, '')
        machine = VmId(vm.region, vm.id, attempt if ATTEMPT.fullmatch(attempt) else '0' * 16)
        return Machine(
            self._text(machine), tags.get(TAG_NAME, ''), self.name, vm.state, created=vm.created,
            endpoint=endpoint, vpn_host=address if running else '',
            private_network=vm.private_network, private_ip=private_ip, region=vm.region,
            kind=f'{vm.kind}{_SPOT}' if vm.spot else vm.kind, image=vm.image, key=vm.key,
            disk_gb=int(disk) if disk.isdecimal() and len(disk) < 7 else None, tags=tags,
            end_command=self.cloud.end_command(machine, tags),
            cost_per_hour=_dollars(tags.get(TAG_PRICE, '')), stopped=vm.stopped,
            billed=vm.billed)

    def capabilities_of(self, machine: Machine) -> Capabilities:
        """Only a spot machine gets a preemption notice, and it cannot be stopped."""
        if machine.kind.endswith(_SPOT):
            return dataclasses.replace(self.capabilities, stop=False)
        return dataclasses.replace(self.capabilities, preemption_notice=())

    def reachable(
        self, machine_id: str, *, name: str, timeout: float, known: Optional[Machine] = None,
    ) -> Machine:
        """Wait until a machine runs and has an address; the polls become rarer."""
        machine = self.vm_id(machine_id)
        cloud = self.cloud.until(self.cancel)

        def look() -> Optional[Machine]:
            vm = cloud.get(machine.region, machine.vm)
            if vm is None:
                return None
            if vm.state not in (MachineState.PENDING, MachineState.RUNNING):
                raise ProviderError(
                    f"'{name}' ({machine.vm}) ended while it was coming up: "
                    f'{vm.reason or f"{cloud.title} gives no reason"}',
                    cloud.end_hint(vm.reason))
            report = self.machine_of(vm)
            return dataclasses.replace(report, id=machine_id, note='; '.join(
                cloud.notes[machine.vm])) if report.endpoint is not None else None

        # a cloud needs some ten seconds: few requests, but a fast machine is noticed soon
        return wait_through(
            look, timeout=timeout, cancel=self.cancel, first=0.5, interval=1.5, longest=5.0,
            what=f"'{name}' ({machine.vm}) to run")

    def reclaims(self, machine_id: str) -> bool:
        return super().reclaims(machine_id) or self.until().is_marked(self.vm_id(machine_id))

    def find(self, tags: Mapping[str, str]) -> Iterator[Machine]:
        cloud = self.until()
        for vms in self.everywhere(cloud, lambda region: list(cloud.find(region, tags))):
            yield from map(self.machine_of, vms)

    def destroy(self, machine_id: str) -> None:
        try:
            machine = self.vm_id(machine_id)
        except MachineNotFound:
            return
        self.cloud.delete(machine)

    def stop(self, machine_id: str) -> None:
        machine = self.vm_id(machine_id)
        vm = self.cloud.get(machine.region, machine.vm)
        if vm is not None and vm.spot:
            raise Unsupported("a spot instance can't be stopped and started again",
                              "use on_exit='delete' or 'keep', or spot=False")
        self.cloud.stop(machine)

    def start(self, machine_id: str) -> None:
        machine, cloud = self.vm_id(machine_id), self.cloud.until(self.cancel)

        def stopped() -> bool:
            vm = cloud.get(machine.region, machine.vm)
            return vm is None or vm.state is not MachineState.STOPPING

        if not stopped():
            wait_through(stopped, timeout=END_TIMEOUT, cancel=self.cancel, first=1.0, interval=1.5,
                         longest=5.0, what=f'{machine.vm} in {machine.region} to be stopped')
        cloud.start(machine)

    def tidy(self, dead: Collection[str] = ()) -> list[str]:
        attempts = {attempt_of(token) for token in dead}

        def ask(region: str) -> list[str]:
            names = self.cloud.leftovers(region, time.time(), attempts)
            for attempt in names:
                self.cloud.sweep(region, attempt)
            where = f' in {region}' if region else ''
            return [f"firewall and key of '{name}'{where}" for name in names.values()]
        return [words for notes in self.everywhere(self.cloud, ask) for words in notes]

    # -- its network ----------------------------------------------------------------------------

    def robot_address(self) -> str:
        return self._address(self._cancel())

    def _address(self, cancel: Optional[threading.Event]) -> str:
        return cancellable(_ROBOT_ADDRESS, cancel, what="asking for the robot's address",
                           grace=lambda: 0.0)

    def allow(self, machine_id: str, port: int, sources: Sequence[str]) -> None:
        # a port is closed even if the launch ends
        cloud = self.until() if sources else self.cloud
        cloud.set_firewall(self.vm_id(machine_id), port, _ROBOT_ADDRESS.with_ipv6(sources))

    def pin(self, machine_id: str, host_key: str) -> None:
        self.until().set_tags(
            self.vm_id(machine_id), {TAG_HOST_KEY: ' '.join(host_key.split()[:2])})

    # -- regions --------------------------------------------------------------------------------

    def nearest(self, names: Sequence[str] = ()) -> str:
        return self.cloud.regions.nearest(names)

    def regions(self, names: Sequence[str] = (), *, every: bool = False) -> list[Region]:
        self.cloud.regions.check(names)
        return self.cloud.regions.ranked(names, every=every)

    def search_in(self, regions: Sequence[str]) -> None:
        self._searched = tuple(regions)

    def _named_regions(self) -> list[str]:
        """Return the regions that the user has named: by an option, else FOGROS2_AWS_REGIONS."""
        variable = f'FOGROS2_{self.name.upper()}_REGIONS'
        return list(self._searched) or os.environ.get(variable, '').replace(',', ' ').split()

    def _base(self) -> str:
        """Return a region for requests that belong to no region."""
        regions = [region for region in self._named_regions() if region != ALL]
        return self.cloud.default_region() or (*regions, self.cloud.base_region)[0]

    def everywhere(self, cloud: VmCloud, question: Callable[[str], T]) -> Iterator[T]:
        """
        Ask all regions at the same time; yield their answers.

        A region that the account must not use has no machine of ours. Its refusal is an error
        only if the user has named the region, or if no region answers.

        :raises FogError: a region does not answer, after the answers of all others.
        """
        regions = self._named_regions()
        named = bool(regions) and ALL not in regions
        if not named:
            regions = sorted(cloud.searched_regions())

        def attempt(region: str) -> tuple[Optional[T], Optional[FogError]]:
            try:
                return question(region), None
            except FogError as error:
                return None, error

        with ThreadPoolExecutor(min(PARALLEL, len(regions)), 'fog-regions') as pool:
            answers = list(pool.map(attempt, regions))
        results = [answer for answer, error in answers if answer is not None]
        yield from results
        for _, error in answers:
            denied = isinstance(error, CloudError) and error.denied
            if error is not None and (named or not results or not denied):
                raise error

    def _region(self, options: VmOptions) -> str:
        """
        Return the region of a machine, or 'nearest'.

        :raises ConfigurationError: nobody has named a region.
        """
        region = options.region or self.cloud.default_region()
        if not region:
            raise ConfigurationError(
                f'no region is named for {options.WHAT}',
                f"region='{self.cloud.base_region}' or region='nearest' names one")
        return region

    # -- ids ------------------------------------------------------------------------------------

    def _text(self, machine: VmId) -> str:
        return f'{self.name}:{"/".join(machine)}'

    def vm_id(self, text: str) -> VmId:
        """
        Parse a machine's id.

        :raises MachineNotFound: not an id of this provider.
        """
        form = rf'{self.name}:([a-z0-9-]+)/({self.cloud.id_form})/({ATTEMPT.pattern})'
        match = re.fullmatch(form, text)
        if match is None:
            raise MachineNotFound(f"'{text}' is no machine at {self.cloud.title}")
        return VmId(*match.groups())


def _market(cloud: VmCloud) -> Any:
    """
    Return the types and prices at a cloud.

    :raises ConfigurationError: the feature that has them is not installed.
    """
    return plugin_system.load('fogros2.market', 'prices')(cloud)


def first_disk(disks: Iterable[Disk]) -> Optional[Disk]:
    """Return the volume that counts among several with one name, None for none."""
    return min(disks, key=lambda disk: (not disk.vm, disk.created, disk.id), default=None)


def disk_in_use(disk: Disk) -> NameTaken:
    """Return the error for a volume that another machine has."""
    return NameTaken(f"the volume '{disk.name}' in {disk.zone or disk.region} is in use by "
                     f'{disk.vm or "another launch"}', 'end that machine: ros2 fog list shows it')


def _beside(
    cloud: VmCloud, regions: Sequence[str], names: Iterable[str],
) -> tuple[list[str], str]:
    """
    Return the regions and the zone for a machine: those of its volumes, if some exist.

    :raises NameTaken: another machine has a volume.
    :raises ConfigurationError: no zone has all of them.
    """
    for region in regions:
        listed = list(cloud.disks(region))
        disks = [disk for name in names if (
            disk := first_disk(one for one in listed if one.name == name)) is not None]
        for disk in disks:
            if disk.vm:
                raise disk_in_use(disk)
        zones = {disk.zone for disk in disks}
        if len(zones) > 1:
            raise ConfigurationError(
                'no machine can have ' + ' and '.join(
                    f"the volume '{disk.name}' in {disk.zone}" for disk in disks),
                'leave one out, or delete it: ros2 fog volume delete NAME')
        if disks:
            return [region], zones.pop()
    return list(regions), ''


def _ip(text: str) -> str:
    with contextlib.suppress(untrusted.InvalidMessage):
        return untrusted.address(text)
    return ''


def _dollars(text: str) -> Optional[Decimal]:
    with contextlib.suppress(InvalidOperation):
        price = Decimal(text)
        return price if price.is_finite() and 0 <= price < 10 ** 6 else None
    return None
