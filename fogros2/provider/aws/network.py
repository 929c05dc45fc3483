# SPDX-License-Identifier: Apache-2.0
"""
A machine's own security group: the firewall that decides who reaches it.

Each machine has its own group. So a launch can close the SSH port of one machine while it needs
another's, and the group can be deleted with its machine.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from fogros2.errors import ConfigurationError, ProviderError
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.failures import AwsError
from fogros2.provider.aws.instances import tag_list, tags_of
from fogros2.provider.vm.cloud import own_name, TAG_SSH_FROM
from fogros2.provider.vm.options import cidr
from fogros2.waiting import wait_until

SSH = 22
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


def create_group(
    account: Account, region: str, *, attempt: str, name: str, vpc: str,
    tags: Mapping[str, str],
) -> str:
    """
    Create a machine's security group and return its id; reuse that of an earlier attempt.

    :param vpc: id; '' for the default VPC.
    """
    where: dict[str, Any] = {'VpcId': vpc} if vpc else {}
    try:
        return str(account.call(
            'ec2', region, 'create_security_group', f"making the security group of '{name}'",
            GroupName=own_name(attempt), Description=f'FogROS2 machine {name}', **where,
            TagSpecifications=[{'ResourceType': 'security-group', 'Tags': tag_list(tags)}],
        )['GroupId'])
    except AwsError as error:
        if error.code != 'InvalidGroup.Duplicate':
            raise
    return str(find_groups(account, region, attempt)[0]['GroupId'])


def open_group(
    account: Account, region: str, group: str, *, attempt: str, name: str, vpn_port: int,
    sources: Sequence[str],
) -> None:
    """
    Open the ports of a new group: the VPN's, and SSH for ``sources``.

    :param sources: networks that reach its SSH port.
    """
    vpn = {'IpProtocol': 'udp', 'FromPort': vpn_port, 'ToPort': vpn_port, **ANYONE}
    try:
        account.call(
            'ec2', region, 'authorize_security_group_ingress',
            f"opening the ports of '{name}'", GroupId=group,
            IpPermissions=[vpn, *([rule('tcp', SSH, sources)] if sources else [])])
    except AwsError as error:
        if error.code != 'InvalidPermission.Duplicate':
            raise
    else:
        if sources:
            account.doors[attempt] = (group, rule('tcp', SSH, sources))


def find_groups(account: Account, region: str, attempt: str) -> list[Mapping[str, Any]]:
    """Return the groups of an attempt, in any VPC."""
    return list(account.call(
        'ec2', region, 'describe_security_groups', 'looking for the security group',
        Filters=[{'Name': 'group-name', 'Values': [own_name(attempt)]}])['SecurityGroups'])


def delete_groups(
    account: Account, region: str, groups: Iterable[str], *, timeout: float = 120.0,
) -> None:
    """
    Delete groups; wait until no instance uses them.

    :raises DeadlineExceeded: an instance still uses a group.
    """
    for group in groups:
        def deleted(group: str = group) -> bool:
            try:
                account.call('ec2', region, 'delete_security_group',
                             'deleting the security group', GroupId=group)
            except AwsError as error:
                if error.code in ('DependencyViolation', 'InvalidGroup.InUse'):
                    return False
                if not error.gone:
                    raise
            return True
        wait_until(deleted, timeout=timeout, interval=1.0, longest=5.0,
                   what=f'the security group {group} in {region} to be deleted',
                   hint=f'aws ec2 delete-security-group --region {region} --group-id {group}')


def allow(
    account: Account, region: str, attempt: str, port: int, sources: Sequence[str],
) -> None:
    """
    Let only ``sources`` reach a TCP port; none closes it.

    The networks of ``ssh_from=`` are admitted together with the others.

    :raises ProviderError: the machine has no group (any more).
    """
    door = account.doors.pop(attempt, None)
    if door is not None and not sources and port == SSH:
        # the first change of a group that this process has created: no look-up is needed
        try:
            account.call('ec2', region, 'revoke_security_group_ingress', f'closing port {port}',
                         GroupId=door[0], IpPermissions=[door[1]])
            return
        except AwsError as error:
            if error.code != 'InvalidPermission.NotFound':
                raise  # another program has changed it
    groups = find_groups(account, region, attempt)
    if not groups:
        raise ProviderError(f'the machine in {region} has no security group any more',
                            'ros2 fog list shows whether it is there')
    group, = groups[:1]
    wanted = {cidr(source) for source in sources}
    if wanted and port == SSH:
        wanted |= set(tags_of(group).get(TAG_SSH_FROM, '').split())
    now = sources_of(group, port)
    for operation, what, networks, tolerated in (
            ('authorize_security_group_ingress', 'opening', wanted - now,
             'InvalidPermission.Duplicate'),
            ('revoke_security_group_ingress', 'closing', now - wanted,
             'InvalidPermission.NotFound')):
        if networks:
            try:
                account.call('ec2', region, operation, f'{what} port {port}',
                             GroupId=group['GroupId'],
                             IpPermissions=[rule('tcp', port, networks)])
            except AwsError as error:
                if error.code != tolerated:
                    raise


def vpc_of(account: Account, region: str, subnet: str) -> str:
    """
    Return the VPC that a subnet belongs to.

    :raises ConfigurationError: there is no such subnet in the region.
    """
    try:
        found = account.call('ec2', region, 'describe_subnets', 'looking for the subnet',
                             SubnetIds=[subnet])['Subnets']
    except AwsError as error:
        if error.code.startswith('InvalidSubnet'):
            raise ConfigurationError(f"there is no subnet '{subnet}' in {region}",
                                     'check subnet= and region=') from error
        raise
    return str(found[0]['VpcId'])


def default_subnets(account: Account, region: str) -> list[str]:
    """Return the default VPC's subnets, one for each zone, by zone."""
    found = account.call(
        'ec2', region, 'describe_subnets', 'looking for zones',
        Filters=[{'Name': 'default-for-az', 'Values': ['true']}])['Subnets']
    return [str(subnet['SubnetId'])
            for subnet in sorted(found, key=lambda entry: str(entry['AvailabilityZone']))]
