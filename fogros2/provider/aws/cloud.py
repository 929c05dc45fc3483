# SPDX-License-Identifier: Apache-2.0
"""EC2 as a cloud of virtual machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import os
import re
import time
from typing import Any, Optional

from fogros2.errors import MachineNotFound
from fogros2.model import MachineSpec
from fogros2.provider.aws import clients, images, instances, login
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.disks import Ec2Disks
from fogros2.provider.aws.network import Ec2Network
from fogros2.provider.aws.options import Options
from fogros2.provider.aws.prices import Ec2Prices
from fogros2.provider.vm.cloud import Order, Place, PRICES_AGE, Vm, VmId
from fogros2.provider.vm.failures import settled, tolerated, unless_gone
from fogros2.provider.vm.regions import read_table, Regions


class Ec2(Ec2Prices, images.Ec2Images, Ec2Network, Ec2Disks):
    """
    EC2 instances, each with its own security group and key pair.

    :param account: the AWS account; None for the account of this computer's user.
    """

    name = 'aws'
    title = 'AWS'
    options = Options
    regions = Regions('AWS', read_table(__file__), 'ec2.{}.amazonaws.com'.format)
    id_form = 'i-[0-9a-f]+'
    base_region = 'us-east-1'
    types_age = PRICES_AGE
    configured = staticmethod(login.configured)

    def __init__(self, account: Optional[Account] = None) -> None:
        self._account: Account = account or clients.usual()

    # -- the account ----------------------------------------------------------------------------

    def check_credentials(self) -> None:
        self._account.check_credentials()

    def whoami(self, region: str) -> str:
        """Return the account; no policy can refuse this request."""
        identity = self._account.having(self.cancel, hasty=True).call(
            'sts', region, 'get_caller_identity', 'asking AWS who we are')
        return f'account {identity["Account"]}, {str(identity["Arn"]).split(":")[-1]}, {region}'

    def default_region(self) -> str:
        return str(os.environ.get('AWS_REGION') or self._account.session().region_name or '')

    def enabled_regions(self) -> list[str]:
        answer = self._account.call(
            'ec2', self.default_region() or self.base_region, 'describe_regions',
            'asking for the regions of the account')
        return sorted(str(entry['RegionName']) for entry in answer['Regions'])

    # -- machines -------------------------------------------------------------------------------

    def find(self, region: str, tags: Mapping[str, str]) -> list[Vm]:
        return [instances.vm_of(region, instance) for instance in self._instances(
            region, tags, 'looking for machines', instances.in_states(instances.ALIVE))]

    def get(self, region: str, vm: str) -> Optional[Vm]:
        matches: list[Mapping[str, Any]] = []
        with unless_gone():
            matches = instances.instances_in(self._account.call(
                'ec2', region, 'describe_instances', f'looking for {vm}',
                InstanceIds=[vm])['Reservations'])
        if not matches:
            if self._account.just_made(vm):
                return None
            raise MachineNotFound(f'there is no {vm} in {region} any more')
        if matches[0]['State']['Name'] == 'terminated' and not self._account.just_made(vm):
            raise MachineNotFound(f'{vm} in {region} was terminated')
        return instances.vm_of(region, matches[0])

    def end_hint(self, reason: str) -> str:
        if re.match(r'Client\.(InternalError|InvalidKMSKey)', reason):
            return ("may these credentials use the KMS key of the account's disks "
                    '(kms:CreateGrant and others)? See doc/aws.md')
        return super().end_hint(reason)

    def is_marked(self, machine: VmId) -> bool:
        """Ask the spot request, which EC2 marks two minutes before the instance's end."""
        requests = self._account.call(
            'ec2', machine.region, 'describe_spot_instance_requests',
            f'asking whether {machine.vm} is reclaimed',
            Filters=[{'Name': 'instance-id', 'Values': [machine.vm]}])['SpotInstanceRequests']
        return any(str(one.get('Status', {}).get('Code', '')).startswith('marked-for-')
                   for one in requests)

    def prepare(self, region: str, order: Order, types: Sequence[str]) -> dict[str, Any]:
        """Return the image of each type, looked up once for all types that use the same."""
        cache: dict[tuple[str, bool, bool], Mapping[str, Any]] = {}
        chosen: dict[str, Any] = {}
        for kind in self.named_types(region, types):
            key = (kind.arch, images.has_nvidia(kind), bool(kind.gpus))
            if key not in cache:
                cache[key] = self.image_for(region, kind, order.options,
                                            order.request.dependencies)
            chosen[kind.name] = cache[key]
        return chosen

    def insert(
        self, place: Place, order: Order, prepared: Any, created: Sequence[str],
        tags: Mapping[str, str],
    ) -> str:
        words = instances.run_request(place, order, prepared, created[0], tags)
        what = f"creating '{order.spec.name}' ({place.kind})"
        answer = settled(
            lambda: self._account.call('ec2', place.region, 'run_instances', what, **words),
            'InvalidGroup.NotFound', 'InvalidKeyPair.NotFound', what=what)
        vm = str(answer['Instances'][0]['InstanceId'])
        self._account.made[vm] = time.monotonic()
        return vm

    def set_tags(self, machine: VmId, tags: Mapping[str, str]) -> None:
        self._call(machine, 'create_tags', f'writing tags of {machine.vm}',
                   Resources=[machine.vm], Tags=instances.tag_list(tags))

    def set_ending(self, machine: VmId, spec: MachineSpec) -> None:
        # EC2 may refuse that for a spot instance, which terminates in any case
        with tolerated('UnsupportedOperation'):
            self._call(machine, 'modify_instance_attribute', f'saying how {machine.vm} ends',
                       InstanceId=machine.vm, Attribute='instanceInitiatedShutdownBehavior',
                       Value=instances.at_shutdown(spec))

    def stop(self, machine: VmId) -> None:
        self._call(machine, 'stop_instances', f'stopping {machine.vm}', InstanceIds=[machine.vm])

    def start(self, machine: VmId) -> None:
        self._call(machine, 'start_instances', f'starting {machine.vm}',
                   InstanceIds=[machine.vm])

    def _call(self, machine: VmId, operation: str, what: str, **words: Any) -> None:
        self._account.call('ec2', machine.region, operation, what, **words)
