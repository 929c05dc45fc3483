# SPDX-License-Identifier: Apache-2.0
"""
What a machine has besides its instance: security group (the firewall) and login key; its end.

Each machine has its own group. So a launch can close the SSH port of one machine while it needs
another's, and the group can be deleted with its machine. An instance without the machine's tag
is never ended.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import time
from typing import Any, Optional

from fogros2.errors import ConfigurationError, ProviderError
from fogros2.provider.aws import instances
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.failures import AwsError
from fogros2.provider.vm.cloud import Order, own_name, TAG_ATTEMPT, TAG_SSH_FROM, VmCloud, VmId
from fogros2.provider.vm.failures import settled, SETTLING, tolerated, wait_through
from fogros2.provider.vm.options import cidr, FREE_PORTS, SSH
from fogros2.waiting import wait_until

#: Time-out in seconds for the end of an instance; usually it takes half a minute.
TIMEOUT = 300.0
#: Sources of WireGuard's port: robots and machines roam, and WireGuard answers only known keys.
ANYONE = {'IpRanges': [{'CidrIp': '0.0.0.0/0'}], 'Ipv6Ranges': [{'CidrIpv6': '::/0'}]}


def rule(protocol: str, port: int, sources: Iterable[str], last: int = 0) -> dict[str, Any]:
    """Return a rule of a security group in EC2's form, for a port or those up to ``last``."""
    networks = sorted({cidr(source) for source in sources})
    permission: dict[str, Any] = {'IpProtocol': protocol, 'FromPort': port, 'ToPort': last or port}
    four = [{'CidrIp': network} for network in networks if ':' not in network]
    six = [{'CidrIpv6': network} for network in networks if ':' in network]
    return {**permission, **({'IpRanges': four} if four else {}),
            **({'Ipv6Ranges': six} if six else {})}


def sources_of(group: Mapping[str, Any], port: int) -> set[str]:
    """Return the networks that reach a TCP port through a group as EC2 describes it."""
    return {
        str(entry.get('CidrIp') or entry.get('CidrIpv6'))
        for permission in group.get('IpPermissions') or ()
        if permission.get('IpProtocol') == 'tcp' and permission.get('FromPort') == port
        for entry in (*(permission.get('IpRanges') or ()), *(permission.get('Ipv6Ranges') or ()))}


class Ec2Network(VmCloud):
    """The part of EC2 that has groups, keys and subnets, and deletes machines."""

    _account: Account

    def begin(self, region: str, order: Order, created: list[str]) -> None:
        """Create the security group and import the key, in parallel."""
        vpc = self._vpc_of(region, order.options.subnet, order.zone) \
            if order.options.subnet else ''
        with ThreadPoolExecutor(1, 'fog-aws') as pool:
            importing = pool.submit(self._import_key, region, order)
            created.append(self._create_group(region, order, vpc))
            self._open_group(region, created[0], order)
            importing.result()

    def _import_key(self, region: str, order: Order) -> None:
        with tolerated('InvalidKeyPair.Duplicate'):
            self._account.call(
                'ec2', region, 'import_key_pair',
                f"importing the login key of '{order.spec.name}'",
                KeyName=own_name(order.attempt),
                PublicKeyMaterial=order.request.authorized_key.encode(),
                TagSpecifications=[{
                    'ResourceType': 'key-pair', 'Tags': instances.tag_list(order.tags)}])

    def _create_group(self, region: str, order: Order, vpc: str) -> str:
        """Create a machine's group and return its id; reuse that of an earlier attempt."""
        name, where = order.spec.name, {'VpcId': vpc} if vpc else {}
        with tolerated('InvalidGroup.Duplicate'):
            group = str(self._account.call(
                'ec2', region, 'create_security_group', f"making the security group of '{name}'",
                GroupName=own_name(order.attempt), Description=f'FogROS2 machine {name}', **where,
                TagSpecifications=[{
                    'ResourceType': 'security-group', 'Tags': instances.tag_list(order.tags)}],
            )['GroupId'])
            self._account.made[group] = time.monotonic()
            return group
        groups = wait_until(
            lambda: self._groups(region, order.attempt) or None, timeout=SETTLING,
            cancel=self._account.cancel, interval=0.5, longest=4.0,
            what=f"the security group of '{name}'")
        return str(groups[0]['GroupId'])

    def _open_group(self, region: str, group: str, order: Order) -> None:
        """Open the ports of a new group: the VPN's, and SSH for the order's sources."""
        port, (first, last) = order.request.vpn_port, FREE_PORTS
        what = f"opening the ports of '{order.spec.name}'"
        rules = [
            {'IpProtocol': 'udp', 'FromPort': port, 'ToPort': port, **ANYONE},
            *([rule('tcp', SSH, order.sources)] if order.sources else []),
            *(rule(protocol, first, order.sources, last)
              for protocol in (('tcp', 'udp') if order.options.fleet else ()))]
        with tolerated('InvalidPermission.Duplicate'):
            settled(
                lambda: self._account.call(
                    'ec2', region, 'authorize_security_group_ingress', what, GroupId=group,
                    IpPermissions=rules),
                'InvalidGroup.NotFound', what=what)
            self._account.admitted[order.attempt] = sorted(map(cidr, order.sources))

    def undo_begin(
        self, region: str, attempt: str, created: Sequence[str],
    ) -> Iterator[tuple[str, Callable[[], None]]]:
        yield 'the login key', lambda: self._drop_key(region, attempt)
        yield 'the security group', lambda: self._drop_groups(
            region, attempt, created, timeout=120.0)

    def _drop_key(self, region: str, attempt: str) -> None:
        self._account.remove(region, 'delete_key_pair', 'deleting the login key',
                             KeyName=own_name(attempt))

    def _groups(self, region: str, attempt: str) -> list[Mapping[str, Any]]:
        """Return the groups of an attempt, in any VPC."""
        return list(self._account.call(
            'ec2', region, 'describe_security_groups', 'looking for the security group',
            Filters=[{'Name': 'group-name', 'Values': [own_name(attempt)]}])['SecurityGroups'])

    def _drop_groups(
        self, region: str, attempt: str, ids: Sequence[str], *, timeout: float,
    ) -> None:
        """
        Delete the groups of an attempt; wait until no instance uses them.

        :param ids: their ids, which EC2 may not report yet if they are new; () to look.
        :raises DeadlineExceeded: an instance still uses a group.
        """
        for group in ids or [
                str(entry['GroupId']) for entry in self._groups(region, attempt)]:
            def deleted(group: str = group) -> bool:
                try:
                    self._account.call('ec2', region, 'delete_security_group',
                                       'deleting the security group', GroupId=group)
                except AwsError as error:
                    if error.code in ('DependencyViolation', 'InvalidGroup.InUse'):
                        return False
                    if not error.gone:
                        raise
                    # EC2 may not know a new group yet, which would stay
                    return not self._account.just_made(group)
                return True
            # a first request without an answer is an error
            if not deleted():
                wait_through(
                    deleted, timeout=timeout, first=1.0, interval=1.5, longest=5.0,
                    what=f'the security group {group} in {region} to be deleted',
                    hint=f'aws ec2 delete-security-group --region {region} --group-id {group}')
            self._account.made.pop(group, None)

    def set_firewall(self, machine: VmId, port: int, sources: Sequence[str]) -> None:
        """Let only ``sources`` reach a TCP port, beside the networks of ``ssh_from=``."""
        if port == SSH and self._account.admits(machine.attempt, sorted(map(cidr, sources))):
            return
        region = machine.region
        groups = self._groups(region, machine.attempt)
        if not groups:
            raise ProviderError(f'the machine in {region} has no security group any more',
                                'ros2 fog list shows whether it is there')
        wanted = {cidr(source) for source in sources}
        if wanted and port == SSH:
            wanted |= set(instances.tags_of(groups[0]).get(TAG_SSH_FROM, '').split())
        now = sources_of(groups[0], port)
        for operation, what, networks, repeated in (
                ('authorize_security_group_ingress', 'opening', wanted - now,
                 'InvalidPermission.Duplicate'),
                ('revoke_security_group_ingress', 'closing', now - wanted,
                 'InvalidPermission.NotFound')):
            if networks:
                with tolerated(repeated):
                    self._account.call('ec2', region, operation, f'{what} port {port}',
                                       GroupId=groups[0]['GroupId'],
                                       IpPermissions=[rule('tcp', port, networks)])

    def _vpc_of(self, region: str, subnet: str, zone: str) -> str:
        """
        Return the VPC that a subnet belongs to.

        :raises ConfigurationError: there is no such subnet in the region, or in the zone.
        """
        subnets = self._account.call(
            'ec2', region, 'describe_subnets', f'looking for the subnet {subnet}',
            SubnetIds=[subnet])['Subnets']
        if zone not in ('', subnets[0]['AvailabilityZone']):
            raise ConfigurationError(f"the subnet '{subnet}' is not in {zone}, as the volume is",
                                     'name a subnet there, or leave subnet= out')
        return str(subnets[0]['VpcId'])

    def places(self, region: str, order: Order) -> Iterator[str]:
        """
        Yield the subnet that is named; else EC2's choice, then the default VPC's subnets.

        With a volume, yield only those in its zone.
        """
        if order.options.subnet or not order.zone:
            yield order.options.subnet
        if not order.options.subnet:
            subnets = self._account.call(
                'ec2', region, 'describe_subnets', 'looking for zones',
                Filters=[{'Name': 'default-for-az', 'Values': ['true']}, *(
                    [{'Name': 'availability-zone', 'Values': [order.zone]}] if order.zone else []
                )])['Subnets']
            yield from (str(subnet['SubnetId']) for subnet in sorted(
                subnets, key=lambda entry: str(entry['AvailabilityZone'])))

    # -- its end --------------------------------------------------------------------------------

    def delete(self, machine: VmId) -> None:
        # no look-up is needed for what this process has created
        if (machine.vm in self._account.made or self._there(machine)) \
                and self._terminate(machine):
            wait_through(
                lambda: not self._there(machine), timeout=TIMEOUT, first=1.5, interval=3.0,
                longest=15.0, hint='ros2 fog delete again later',
                what=f'{machine.vm} in {machine.region} to be terminated')
        self._account.made.pop(machine.vm, None)
        self.sweep(machine.region, machine.attempt)

    def _terminate(self, machine: VmId) -> bool:
        """Terminate an instance; return whether its end has to be awaited."""
        def ask() -> Optional[list[Mapping[str, Any]]]:
            try:
                return list(self._account.call(
                    'ec2', machine.region, 'terminate_instances', f'ending {machine.vm}',
                    InstanceIds=[machine.vm])['TerminatingInstances'])
            except AwsError as error:
                if not error.gone:
                    raise
                # EC2 may not report a new instance yet, which would continue to run
                return None if self._account.just_made(machine.vm) else []

        changes = wait_until(ask, timeout=TIMEOUT, interval=1.0, longest=5.0,
                             what=f'{machine.vm} in {machine.region} to be known')
        return any(entry['CurrentState']['Name'] != 'terminated' for entry in changes)

    def _there(self, machine: VmId) -> bool:
        # filters: an id that EC2 does not know would be an error
        matches = self._instances(
            machine.region, {TAG_ATTEMPT: machine.attempt}, f'watching {machine.vm} end',
            {'Name': 'instance-id', 'Values': [machine.vm]})
        return any(instance['State']['Name'] != 'terminated' for instance in matches)

    def _instances(
        self, region: str, tags: Mapping[str, str], what: str, *filters: Mapping[str, Any],
    ) -> list[Mapping[str, Any]]:
        """Return the instances of FogROS2 with all of ``tags``, in EC2's form."""
        return instances.instances_in(self._account.pages(
            'ec2', region, 'describe_instances', 'Reservations', what,
            Filters=[*instances.tag_filters(tags), *filters]))

    def sweep(self, region: str, attempt: str) -> None:
        self._drop_key(region, attempt)
        self._drop_groups(region, attempt, (), timeout=TIMEOUT)
        # an image may have disks that do not end with the instance
        for disk in self._account.pages(
                'ec2', region, 'describe_volumes', 'Volumes', 'looking for disks', Filters=[
                    {'Name': f'tag:{TAG_ATTEMPT}', 'Values': [attempt]},
                    {'Name': 'status', 'Values': ['available', 'error']}]):
            self._account.remove(region, 'delete_volume', 'deleting a disk',
                                 VolumeId=disk['VolumeId'])

    def end_attempt(self, region: str, attempt: str) -> bool:
        matches = self._instances(region, {TAG_ATTEMPT: attempt}, 'looking for what was made',
                                  instances.in_states(instances.ALIVE))
        if matches:
            self._account.remove(region, 'terminate_instances', 'ending what was made',
                                 InstanceIds=[instance['InstanceId'] for instance in matches])
        return bool(matches)

    def remains(self, region: str) -> list[dict[str, str]]:
        # the end of a machine deletes its disk and address, but not its group and key
        entries = [
            *self._account.pages('ec2', region, 'describe_security_groups', 'SecurityGroups',
                                 'looking for what is left', Filters=instances.tag_filters({})),
            *self._account.call('ec2', region, 'describe_key_pairs', 'looking for what is left',
                                Filters=instances.tag_filters({}))['KeyPairs']]
        return [instances.tags_of(entry) for entry in entries]

    def attempts(self, region: str) -> list[str]:
        return [instances.tags_of(instance)[TAG_ATTEMPT] for instance in self._instances(
            region, {}, 'looking for machines',
            instances.in_states([*instances.ALIVE, 'shutting-down']))]
