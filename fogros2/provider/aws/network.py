# SPDX-License-Identifier: Apache-2.0
"""
Who reaches a machine: its own security group, and where this robot's connections come from.

A group per machine, not per launch: the SSH port of one is closed when its VPN carries while
another's is still needed, and it can be deleted with its machine whatever the others do.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import contextlib
import ipaddress
import os
import socket
import threading
import time
from typing import Any
import urllib.request

from fogros2.errors import ConfigurationError, ProviderError
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.failures import AwsError, code_of, GONE
from fogros2.provider.aws.instances import own_name, tag_list, TAG_SSH_FROM, tags_of
from fogros2.provider.aws.options import cidr
from fogros2.waiting import wait_until

#: Names this robot's address (or network) as machines see it, so that nobody is asked.
ADDRESS_VARIABLE = 'FOGROS2_ROBOT_ADDRESS'
#: Who tells the address from which we come; AWS's own service unless the variable names another.
CHECKIP, CHECKIP_VARIABLE = 'https://checkip.amazonaws.com', 'FOGROS2_AWS_CHECKIP'
#: Seconds for which an address is taken as it is, so that machines of one launch ask once.
ADDRESS_AGE = 5.0
SSH = 22
#: An address of AWS's, and any port.
FAR_IPV6 = ('2600:1f18::1', 22)
#: Whom WireGuard's port is open to: robots roam, machines dial each other, and it answers nobody
#: whose key it doesn't know.
ANYONE = {'IpRanges': [{'CidrIp': '0.0.0.0/0'}], 'Ipv6Ranges': [{'CidrIpv6': '::/0'}]}


class RobotAddress:
    """The address that this computer's connections come from, asked for at most every 5 s."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known = ('', '', 0.0)

    def __call__(self) -> str:
        """
        Return it in CIDR form.

        :raises ConfigurationError: the variable that names it makes no sense.
        :raises ProviderError: nobody tells.
        """
        told = os.environ.get(ADDRESS_VARIABLE, '')
        if told:
            return cidr(told)
        url = os.environ.get(CHECKIP_VARIABLE, CHECKIP)
        with self._lock:
            address, asked, when = self._known
            if asked != url or time.monotonic() - when > ADDRESS_AGE:
                address = self._ask(url)
                self._known = (address, url, time.monotonic())
            return address

    def with_ipv6(self, networks: Iterable[str]) -> list[str]:
        """Return networks, and where this computer was found among them its IPv6 address too."""
        named = list(networks)
        own = own_ipv6() if self._known[0] in named else ''
        return [*named, *([own] if own else [])]

    def _ask(self, url: str) -> str:
        hint = f'{ADDRESS_VARIABLE}=... names it'
        try:
            with urllib.request.urlopen(url, timeout=5.0) as answer:
                said = answer.read(100).decode('ascii', 'replace').strip()
            return cidr(str(ipaddress.ip_address(said)))
        except OSError as error:
            own = own_ipv6()
            if own:
                return own  # a computer without IPv4 reaches nobody who has that alone
            raise ProviderError(
                f"{url} does not tell this robot's public address: {error}", hint) from error
        except ValueError as error:
            raise ProviderError(f"{url} told no address but '{said[:40]}'", hint) from error


def own_ipv6() -> str:
    """Return the address (CIDR) of this computer's IPv6 connections, '' without; sends nothing."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
        probe.connect(FAR_IPV6)  # the system chooses a way, and the address that goes with it
        address = ipaddress.IPv6Address(probe.getsockname()[0])
        if address.is_global:
            return f'{address}/128'
    return ''


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
    Make a machine's security group and return its id; one of an earlier attempt is taken on.

    :param vpc: id; '' for the default VPC.
    """
    place: dict[str, Any] = {'VpcId': vpc} if vpc else {}
    try:
        return str(account.call(
            'ec2', region, 'create_security_group', f"making the security group of '{name}'",
            GroupName=own_name(attempt), Description=f'FogROS2 machine {name}', **place,
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
    Open the ports of a new group: the VPN's, and that of SSH for those who may log in.

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
    Delete groups; waits until nothing uses them, as an instance does until it is gone.

    :raises DeadlineExceeded: something uses one still.
    """
    for group in groups:
        def deleted(group: str = group) -> bool:
            try:
                account.call('ec2', region, 'delete_security_group',
                             'deleting the security group', GroupId=group)
            except AwsError as error:
                if error.code in ('DependencyViolation', 'InvalidGroup.InUse'):
                    return False
                if code_of(error) not in GONE:
                    raise
            return True
        wait_until(deleted, timeout=timeout, interval=1.0, longest=5.0,
                   what=f'the security group {group} in {region} to be deleted',
                   hint=f'aws ec2 delete-security-group --region {region} --group-id {group}')


def allow(
    account: Account, region: str, attempt: str, port: int, sources: Sequence[str],
) -> None:
    """
    Let ``sources`` reach a TCP port, they alone; none closes it.

    What the launch file named with ``ssh_from=`` is let in together with anybody else.

    :raises ProviderError: the machine has no group (any more).
    """
    door = account.doors.pop(attempt, None)
    if door is not None and not sources and port == SSH:
        # the first change of what this process has made: nothing has to be asked
        try:
            account.call('ec2', region, 'revoke_security_group_ingress', f'closing port {port}',
                         GroupId=door[0], IpPermissions=[door[1]])
            return
        except AwsError as error:
            if error.code != 'InvalidPermission.NotFound':
                raise  # somebody else has changed it meanwhile
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
