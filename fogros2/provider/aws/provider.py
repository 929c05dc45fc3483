# SPDX-License-Identifier: Apache-2.0
"""EC2 instances as machines: the Provider's methods, each put together from its own module."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import dataclasses
from decimal import Decimal
import threading
import time
from typing import Any, ClassVar, Optional

from fogros2.errors import (
    ConfigurationError,
    FogError,
    MachineNotFound,
    ProviderError,
    Unsupported,
)
from fogros2.model import CreateRequest, Image, Machine, MachineSpec, MachineState
from fogros2.provider import Provider
from fogros2.provider.aws import (
    clients,
    ending,
    everywhere,
    images,
    instances,
    network,
    patience,
    spot,
    user_data,
)
from fogros2.provider.aws import regions as places
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.creation import Creation
from fogros2.provider.aws.failures import AwsError, code_of, GONE
from fogros2.provider.aws.instances import MachineId
from fogros2.provider.aws.options import check_spec, DEFAULT_TYPE, NEAREST, Options
from fogros2.waiting import wait_until

#: One for all providers of this process, or each machine of a launch would ask anew.
_ROBOT_ADDRESS = network.RobotAddress()


class AWSProvider(Provider):
    """
    EC2 instances.

    :param account: who asks AWS; None for the account of this computer's user.
    """

    name: ClassVar[str] = instances.PROVIDER
    shell_kind: ClassVar[str] = 'ssh'
    agent_directory: ClassVar[str] = user_data.AGENT_DIRECTORY
    agent_program: ClassVar[str] = user_data.AGENT_PROGRAM
    firewall: ClassVar[bool] = True
    one_time_host_key: ClassVar[bool] = True
    notice: ClassVar[tuple[str, ...]] = spot.NOTICE

    def __init__(self, account: Optional[Account] = None) -> None:
        self._account = account or clients.usual()
        self._robot_address = _ROBOT_ADDRESS
        self._regions: tuple[str, ...] = ()
        #: What people should know of an instance when it is up.
        self._notes: dict[str, str] = {}

    # -- before anything is made ----------------------------------------------------------------

    @classmethod
    def configured(cls) -> bool:
        """Return whether somebody has set AWS up here."""
        return clients.configured()

    def set_regions(self, regions: Sequence[str]) -> None:
        """Look in these regions from now on; 'all' are all that the account has enabled."""
        self._regions = tuple(regions)

    def answers(self) -> str:
        """Ask AWS who we are, which no policy can refuse."""
        region = everywhere.base(self._account, self._regions)
        told = self._account.call('sts', region, 'get_caller_identity', 'asking AWS who we are',
                                  hasty=True)
        return f'account {told["Account"]}, {str(told["Arn"]).split(":")[-1]}, {region}'

    def check(self, spec: MachineSpec) -> None:
        """Look at the options, for boto3 and for credentials; AWS isn't asked."""
        options = check_spec(spec)
        self._account.check_credentials()
        region = self._region(options)
        for one in (*((region,) if region != NEAREST else ()), *options.regions):
            options.in_region(one)

    def resolve(self, spec: MachineSpec) -> MachineSpec:
        """Choose the region and the type, and refuse what costs more than ``max_price``."""
        return self._resolved(spec, self.cancel)

    def _resolved(self, spec: MachineSpec, cancel: Optional[threading.Event]) -> MachineSpec:
        from fogros2.provider.aws import choices
        from fogros2.provider.aws.prices import Market
        options = check_spec(spec)
        chosen: dict[str, Any] = {}
        region = self._region(options)
        if region == NEAREST:
            among = options.common_regions()
            region = choices.nearest_region(among)
            if not options.regions and not options.ami_image:
                chosen['regions'] = [one for one in places.neighbours(region)
                                     if among is None or one in among]
        options = options.in_region(region)
        kind = options.ec2_instance_type
        market = Market(self._account.client, cancel=cancel)
        if options.chooses_type:
            wants = choices.wants(
                arch=options.arch or None, min_cpu=int(options.min_cpu) or None,
                min_memory_gb=options.min_memory_gb or None, cpu_type=options.cpu_type or None,
                gpu=int(options.gpu) if options.gpu.isdigit() else options.gpu or None,
                gpu_memory_gb=options.gpu_memory_gb or None, max_price=options.max_price,
                spot=options.spot)
            choice = choices.choose([region], wants, market)
            kind = choice.chosen.type.name
            # the next cheapest fit as well: where there is no room for the cheapest
            chosen['instance_types'] = list(options.instance_types) or [
                offer.type.name for offer in choice.offers[1:3]]
        kind = kind or DEFAULT_TYPE
        if options.max_price is not None and not options.chooses_type:
            price = choices.price_of(region, kind, spot=options.spot, market=market)
            if price is not None and price > options.max_price:
                raise ConfigurationError(
                    f'{kind} in {region} costs {price} US dollars an hour, more than max_price='
                    f'{options.max_price}', 'ros2 fog price shows what is cheaper')
        # a mapping stays: the launch may go on in another region
        if not isinstance(spec.options.get('ec2_instance_type'), Mapping):
            chosen['ec2_instance_type'] = kind
        return dataclasses.replace(spec, options={**spec.options, **chosen, 'region': region})

    def choices(self, asked: MachineSpec, chosen: MachineSpec) -> list[str]:
        """Return the type and the region, and where the launch goes on if there is no room."""
        options = Options.parse(chosen.options)
        options = options.in_region(options.region)
        kinds = [kind for kind in options.instance_types if kind != options.ec2_instance_type]
        more = [' or '.join(kinds), *([f'in {" or ".join(options.regions)}']
                                      if options.regions else [])]
        return [f'{options.ec2_instance_type} in {options.region}',
                *([f'without room there {", ".join(filter(None, more))}'] if any(more) else [])]

    def architecture(self, spec: MachineSpec) -> str:
        """Return that of the instance types that a resolved spec may take, if it is one."""
        options = Options.parse(spec.options)
        options = options.in_region(self._region(options))
        names = dict.fromkeys(
            [options.ec2_instance_type or DEFAULT_TYPE, *options.instance_types])
        found = {kind.arch for kind in images.kinds(
            self._account, self._region(options), list(names))}
        (arch,) = found if len(found) == 1 else ('',)
        return 'aarch64' if arch == 'arm64' else arch

    def cost_per_hour(self, spec: MachineSpec) -> Optional[Decimal]:
        """Return the price of a machine (US dollars an hour); its disk and traffic come on top."""
        options = Options.parse(spec.options)
        region = self._region(options)
        if region == NEAREST:
            return None
        options = options.in_region(region)
        if options.chooses_type:
            return None
        return self._price(region, options.ec2_instance_type or DEFAULT_TYPE, options.spot,
                           self.cancel)

    def _price(
        self, region: str, kind: str, spot: bool, cancel: Optional[threading.Event] = None,
    ) -> Optional[Decimal]:
        from fogros2.provider.aws import choices
        from fogros2.provider.aws.prices import Market
        with contextlib.suppress(FogError):
            return choices.price_of(
                region, kind, spot=spot, market=Market(self._hasty, cancel=cancel))
        return None

    def _hasty(self, service: str, region: str) -> Any:
        return self._account.client(service, region, hasty=True)

    # -- a machine's life -----------------------------------------------------------------------

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Ask for an instance where there is room for one; nothing is left of a failure."""
        spec = self._chosen(spec, request.cancel)
        options = check_spec(spec)
        creation = Creation(
            self._account, spec, request, options,
            robot_address=lambda: self._sources(request.cancel),
            price=lambda region, kind: self._price(region, kind, options.spot, request.cancel))
        machine = creation.run(list(dict.fromkeys([self._region(options), *options.regions])))
        self._account.made[machine.instance] = time.monotonic()
        if creation.undo_failures:
            self._notes[machine.instance] = '; '.join(map(str, creation.undo_failures))
        return str(machine)

    def _chosen(self, spec: MachineSpec, cancel: Optional[threading.Event]) -> MachineSpec:
        """Return a spec with its choices made, as ``resolve`` has done for a launch."""
        options = check_spec(spec)
        unresolved = options.chooses_type or self._region(options) == NEAREST
        return self._resolved(spec, cancel) if unresolved else spec

    def adopt(self, machine_id: str, spec: MachineSpec, tags: Mapping[str, str]) -> None:
        """Write tags anew, and whether the machine stops or ends when it shuts itself down."""
        machine = MachineId.parse(machine_id)
        account = self._rising()
        account.call('ec2', machine.region, 'create_tags', f'taking {machine.instance} over',
                     Resources=[machine.instance], Tags=instances.tag_list(tags))
        account.call('ec2', machine.region, 'modify_instance_attribute',
                     f'saying how {machine.instance} ends', InstanceId=machine.instance,
                     Attribute='instanceInitiatedShutdownBehavior',
                     Value=instances.at_shutdown(spec))

    def _rising(self) -> Account:
        """Return the account for a call on a launch's way up, which ends with the launch."""
        ending = self.cancel is None or self.cancel.is_set()
        return self._account if ending else self._account.until(self.cancel)

    def describe(self, machine_id: str) -> Machine:
        """Return what EC2 knows of an instance now."""
        machine = MachineId.parse(machine_id)
        found = self._look(machine, self._rising())
        if found is None:
            return Machine(machine_id, '', self.name, MachineState.PENDING, place=machine.region)
        if found['State']['Name'] == 'terminated':
            raise MachineNotFound(f'{machine.instance} in {machine.region} was terminated')
        return dataclasses.replace(instances.machine_of(machine.region, found), id=machine_id)

    def _look(
        self, machine: MachineId, account: Optional[Account] = None,
    ) -> Optional[Mapping[str, Any]]:
        """
        Return an instance as EC2 describes it, None for one so new that it isn't known yet.

        :raises MachineNotFound: it isn't known (any more).
        """
        try:
            found = instances.instances_in((account or self._account).call(
                'ec2', machine.region, 'describe_instances', f'looking for {machine.instance}',
                InstanceIds=[machine.instance])['Reservations'])
        except AwsError as error:
            if code_of(error) not in GONE:
                raise
            found = []
        if found:
            return found[0]
        if self._account.just_made(machine.instance):
            return None
        raise MachineNotFound(f'there is no {machine.instance} in {machine.region} any more')

    def reachable(
        self, machine_id: str, *, name: str, timeout: float, cancel: threading.Event,
    ) -> Machine:
        """Wait until an instance runs and has an address; EC2 is asked ever less often."""
        machine = MachineId.parse(machine_id)
        account = self._account.until(cancel)

        def look() -> Optional[Machine]:
            instance = self._look(machine, account)
            if instance is None:
                return None
            found = instances.machine_of(machine.region, instance)
            if found.state not in (MachineState.PENDING, MachineState.RUNNING):
                raise ProviderError(
                    f"'{name}' ({machine.instance}) ended while it was coming up: "
                    f"{instances.reason_of(instance) or 'EC2 does not say why'}",
                    'the EC2 console has its system log')
            ready = found.state is MachineState.RUNNING and found.shell is not None
            self._account.disks[machine.instance] = instances.own_disks(instance)
            return dataclasses.replace(
                found, id=machine_id, note=self._notes.get(machine.instance, ''),
            ) if ready else None

        # it takes EC2 some ten seconds: few questions, but a fast one is seen soon
        return wait_until(
            look, timeout=timeout, cancel=cancel, first=0.5, interval=1.5, longest=5.0,
            what=f"'{name}' ({machine.instance}) to run")

    def find(self, tags: Mapping[str, str]) -> Iterator[Machine]:
        """Yield the instances that carry all of ``tags``, of all regions at once."""
        account = self._rising()

        def ask(region: str) -> list[Machine]:
            found = instances.instances_in(account.pages(
                'ec2', region, 'describe_instances', 'Reservations', 'looking for machines',
                Filters=[*instances.tag_filters(tags),
                         {'Name': 'instance-state-name', 'Values': list(instances.ALIVE)}]))
            return [instances.machine_of(region, instance) for instance in found]
        for machines in everywhere.ask(account, self._regions, ask):
            yield from machines

    def destroy(self, machine_id: str) -> None:
        """End an instance and all that was made for it; returns when everything is gone."""
        try:
            machine = MachineId.parse(machine_id)
        except MachineNotFound:
            return
        ending.destroy(self._account, machine)

    def stop(self, machine_id: str) -> None:
        """Have an instance stop; its disk stays, and is billed."""
        machine = MachineId.parse(machine_id)
        found = self._look(machine)
        if found is not None and found.get('InstanceLifecycle') == 'spot':
            raise Unsupported("a spot instance can't be stopped and started again",
                              "use on_exit='delete' or 'keep', or spot=False")
        self._account.call('ec2', machine.region, 'stop_instances', f'stopping {machine.instance}',
                           InstanceIds=[machine.instance])

    def start(self, machine_id: str) -> None:
        """Start a stopped instance; one that is stopping still is waited for."""
        machine = MachineId.parse(machine_id)

        def stopped() -> bool:
            found = self._look(machine)
            return found is None or found['State']['Name'] != 'stopping'

        wait_until(stopped, timeout=ending.PATIENCE, interval=1.0, longest=5.0,
                   what=f'{machine.instance} in {machine.region} to be stopped')
        self._account.call('ec2', machine.region, 'start_instances',
                           f'starting {machine.instance}', InstanceIds=[machine.instance])

    def tidy(self) -> list[str]:
        """Delete groups and keys of machines that ended by themselves."""
        def ask(region: str) -> list[str]:
            found = ending.leftovers(self._account, region, time.time())
            for attempt in found:
                ending.sweep(self._account, region, attempt)
            return [f"security group and key of '{name}' in {region}" for name in found.values()]
        return [words for found in everywhere.ask(self._account, self._regions, ask)
                for words in found]

    def notice_for(self, machine: Machine) -> tuple[str, ...]:
        """Return what asks for the notice of a spot instance; no other is taken away."""
        return self.notice if instances.is_spot(machine) else ()

    # -- who reaches it, and who it is ----------------------------------------------------------

    def robot_address(self) -> str:
        """Return this computer's public address as AWS sees it, or as the user has named it."""
        ending = self.cancel is None or self.cancel.is_set()
        return self._asked_address(None if ending else self.cancel)

    def _asked_address(self, cancel: Optional[threading.Event]) -> str:
        return patience.unless(cancel, self._robot_address, "asking for the robot's address")

    def _sources(self, cancel: Optional[threading.Event]) -> list[str]:
        return self._robot_address.with_ipv6([self._asked_address(cancel)])

    def allow(self, machine_id: str, port: int, sources: Sequence[str]) -> None:
        """Change the machine's own security group."""
        machine = MachineId.parse(machine_id)
        # a port that is to be closed is, whatever ends
        account = self._rising() if sources else self._account
        network.allow(account, machine.region, machine.attempt, port,
                      self._robot_address.with_ipv6(sources))

    def pin(self, machine_id: str, host_key: str) -> None:
        """Keep the machine's new host key in a tag of the instance."""
        machine = MachineId.parse(machine_id)
        self._rising().call(
            'ec2', machine.region, 'create_tags', f'noting the host key of {machine.instance}',
            Resources=[machine.instance], Tags=instances.tag_list({
                instances.TAG_HOST_KEY: ' '.join(host_key.split()[:2])}))

    # -- images ---------------------------------------------------------------------------------

    def bake(self, machine_id: str, name: str, dependencies: str) -> str:
        """Have EC2 make an AMI of an instance, which runs on."""
        machine = MachineId.parse(machine_id)
        found = self._look(machine)
        if found is None:
            raise MachineNotFound(f'EC2 does not know {machine.instance} yet', 'try again')
        return images.bake(self._account, machine.region, found, name, dependencies)

    def images(self) -> Iterator[Image]:
        """Yield the AMIs that were baked, of all regions."""
        account = self._rising()
        for found in everywhere.ask(
                account, self._regions, lambda r: list(images.images_in(account, r))):
            yield from found

    def delete_image(self, image_id: str) -> None:
        """Deregister an AMI and delete its snapshots."""
        images.delete(self._account, image_id)

    # -- regions --------------------------------------------------------------------------------

    def _region(self, options: Options) -> str:
        """
        Return the region that a machine is asked for in, or 'nearest'.

        :raises ConfigurationError: nobody has named one.
        """
        region = options.region or self._account.region()
        if not region:
            raise ConfigurationError(
                'no region is named for a machine at AWS',
                "region='eu-central-1', region='nearest', or: aws configure")
        return region
