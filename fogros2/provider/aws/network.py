# SPDX-License-Identifier: Apache-2.0
"""
A machine's own security group, the firewall that decides who reaches it, and its login key.

Each machine has its own group. So a launch can close the SSH port of one machine while it needs
another's, and the group can be deleted with its machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from fogros2.errors import ConfigurationError, ProviderError
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.failures import AwsError
from fogros2.provider.aws.instances import tag_list, tags_of
from fogros2.provider.vm.cloud import Order, own_name, TAG_SSH_FROM, VmCloud, VmId
from fogros2.provider.vm.failures import tolerated
from fogros2.provider.vm.options import cidr, SSH
from fogros2.waiting import wait_until

#: Sources of WireGuard's port: robots and machines roam, and WireGuard answers only known keys.
ANYONE = {'IpRanges': [{'CidrIp': '0.0.0.0/0'}], 'Ipv6Ranges': [{'CidrIpv6': '::/0'}]}


def rule(protocol: str, port: int, sources: Iterable[str]) -> dict[str, Any]:
    """Return a rule of a security group in EC2's form."""
    networks = sorted({cidr(source) for source in sources})
    found: dict[str, Any] = {'IpProtocol': protocol, 'FromPort': port, 'ToPort': port}
    four = [{'CidrIp': network} for network in networks if ':' not in network]
    six = [{'CidrIpv6': network} for network in networks if ':' in network]
    return {**found, **({'IpRanges': four} if four else {}),
            **({'Ipv6Ranges': six} if six else {})}


def sources_of(group: Mapping[str, Any], port: int) -> set[str]:
    """Return the networks that reach a TCP port through a group as EC2 describes it."""
    return {
        str(entry.get('CidrIp') or entry.get('CidrIpv6'))
        for permission in group.get('IpPermissions') or ()
        if permission.get('IpProtocol') == 'tcp' and permission.get('FromPort') == port
        for entry in (*(permission.get('IpRanges') or ()), *(permission.get('Ipv6Ranges') or ()))}


class Ec2Network(VmCloud):
    """The part of EC2 that has groups, keys and subnets."""

    _account: Account

    def begin(self, region: str, order: Order, created: list[str]) -> None:
        """Create the security group and import the key, in parallel."""
        vpc = self._vpc_of(region, order.options.subnet) if order.options.subnet else ''
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
                TagSpecifications=[{'ResourceType': 'key-pair', 'Tags': tag_list(order.tags)}])

    def _create_group(self, region: str, order: Order, vpc: str) -> str:
        """Create a machine's group and return its id; reuse that of an earlier attempt."""
        name, where = order.spec.name, {'VpcId': vpc} if vpc else {}
        with tolerated('InvalidGroup.Duplicate'):
            return str(self._account.call(
                'ec2', region, 'create_security_group', f"making the security group of '{name}'",
                GroupName=own_name(order.attempt), Description=f'FogROS2 machine {name}', **where,
                TagSpecifications=[{
                    'ResourceType': 'security-group', 'Tags': tag_list(order.tags)}],
            )['GroupId'])
        return str(self._groups(region, order.attempt)[0]['GroupId'])

    def _open_group(self, region: str, group: str, order: Order) -> None:
        """Open the ports of a new group: the VPN's, and SSH for the order's sources."""
        port, ssh = order.request.vpn_port, rule('tcp', SSH, order.sources)
        with tolerated('InvalidPermission.Duplicate'):
            self._account.call(
                'ec2', region, 'authorize_security_group_ingress',
                f"opening the ports of '{order.spec.name}'", GroupId=group, IpPermissions=[
                    {'IpProtocol': 'udp', 'FromPort': port, 'ToPort': port, **ANYONE},
                    *([ssh] if order.sources else [])])
            if order.sources:
                self._account.doors[order.attempt] = (group, ssh)
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
        self, region: str, attempt: str, known: Sequence[str], *, timeout: float,
    ) -> None:
        """
        Delete the groups of an attempt; wait until no instance uses them.

        :param known: their ids, which EC2 may not report yet if they are new; () to look.
        :raises DeadlineExceeded: an instance still uses a group.
        """
        for group in known or [
                str(found['GroupId']) for found in self._groups(region, attempt)]:
            def deleted(group: str = group) -> bool:
                with tolerated('DependencyViolation', 'InvalidGroup.InUse'):
                    self._account.remove(region, 'delete_security_group',
                                         'deleting the security group', GroupId=group)
                    return True
                return False
            wait_until(
                deleted, timeout=timeout, interval=1.0, longest=5.0,
                what=f'the security group {group} in {region} to be deleted',
                hint=f'aws ec2 delete-security-group --region {region} --group-id {group}')

    def set_firewall(self, machine: VmId, port: int, sources: Sequence[str]) -> None:
        """Let only ``sources`` reach a TCP port, beside the networks of ``ssh_from=``."""
        if port == SSH and self._account.admits(machine.attempt, sorted(map(cidr, sources))):
            return
        region, door = machine.region, self._account.doors.pop(machine.attempt, None)
        if door is not None and not sources and port == SSH:
            # the first change of a group that this process has created: no look-up is needed
            with tolerated('InvalidPermission.NotFound'):  # another program has changed it
                self._account.call(
                    'ec2', region, 'revoke_security_group_ingress', f'closing port {port}',
                    GroupId=door[0], IpPermissions=[door[1]])
                return
        groups = self._groups(region, machine.attempt)
        if not groups:
            raise ProviderError(f'the machine in {region} has no security group any more',
                                'ros2 fog list shows whether it is there')
        wanted = {cidr(source) for source in sources}
        if wanted and port == SSH:
            wanted |= set(tags_of(groups[0]).get(TAG_SSH_FROM, '').split())
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

    def _vpc_of(self, region: str, subnet: str) -> str:
        """
        Return the VPC that a subnet belongs to.

        :raises ConfigurationError: there is no such subnet in the region.
        """
        try:
            found = self._account.call(
                'ec2', region, 'describe_subnets', 'looking for the subnet',
                SubnetIds=[subnet])['Subnets']
        except AwsError as error:
            if error.code.startswith('InvalidSubnet'):
                raise ConfigurationError(f"there is no subnet '{subnet}' in {region}",
                                         'check subnet= and region=') from error
            raise
        return str(found[0]['VpcId'])

    def places(self, region: str, order: Order) -> Iterator[str]:
        """Yield the subnet that is named; else EC2's choice, then the default VPC's subnets."""
        yield order.options.subnet
        if not order.options.subnet:
            found = self._account.call(
                'ec2', region, 'describe_subnets', 'looking for zones',
                Filters=[{'Name': 'default-for-az', 'Values': ['true']}])['Subnets']
            yield from (str(subnet['SubnetId']) for subnet in sorted(
                found, key=lambda entry: str(entry['AvailabilityZone'])))
