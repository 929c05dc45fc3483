# SPDX-License-Identifier: Apache-2.0
"""Choose the subnet, addresses and port of a launch's VPN; the ports of DDS."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import ipaddress
import socket

from fogros2 import untrusted
from fogros2.errors import ConfigurationError, VpnError
from fogros2.model import Command, NETWORK_PREFIX

#: RFC 2544's range for benchmarks. Home and company networks (RFC 1918), providers' NAT and
#: Tailscale (100.64.0.0/10), clouds' VPCs and containers do not use it, so a launch normally does
#: not collide with them. Some proxies ("fake IP") use a part of it. That part is skipped, as are
#: the subnets of other launches on the same robot.
POOL = '198.18.0.0/15'
#: Variable with another pool in CIDR form, for users who need the default pool otherwise.
POOL_VARIABLE = 'FOGROS2_VPN_POOL'
#: Variable with the robot's UDP port, for robots behind a router that forwards a port. Machines
#: that have to dial the robot, such as pods that cannot be dialled from outside, use that port.
PORT_VARIABLE = 'FOGROS2_VPN_PORT'
#: A launch's subnet has one robot and up to 222 machines. From this number on, its addresses are
#: free for further peers of the machines.
FIRST_FREE = 224
#: Networks with a shorter prefix mean "everything" in some VPN (two halves, four quarters). They
#: do not collide: the more specific route wins.
EVERYTHING = 8
#: RTPS 2.5, 9.6.2.4: multicast group of the announcements of DDS.
DISCOVERY_GROUP = '239.255.0.1'

_Network = ipaddress.IPv4Network


def pool_from(environment: Mapping[str, str]) -> str:
    """
    Return the pool in CIDR form: the environment's, or :data:`POOL`.

    :raises ConfigurationError: the environment's pool is not an IPv4 network with room for a /24,
        or its multicast groups are those of the LAN.
    """
    text = environment.get(POOL_VARIABLE) or POOL
    return str(_pool(text))


def choose_subnet(used: Iterable[str], *, launch_id: str, pool: str = POOL) -> str:
    """
    Choose a /24 of the pool that overlaps no network in use; return it in CIDR form.

    The same launch id and networks give the same subnet. Different ids start the search at
    different subnets, so that launches that start together avoid each other.

    :param used: networks and addresses in CIDR form, on the robot and on known machines;
        IPv6 networks and those that mean "everything" are ignored.
    :param launch_id: hexadecimal digits.
    :raises VpnError: the whole pool is in use.
    :raises ConfigurationError: the pool is unfit, as for :func:`pool_from`.
    """
    candidates = [network for network in _pool(pool).subnets(new_prefix=NETWORK_PREFIX)
                  if not uses_lan_groups(str(network))]
    networks = [network for network in map(_network, used) if network is not None]
    begin = int(launch_id, 16) % len(candidates)
    for candidate in candidates[begin:] + candidates[:begin]:
        if not any(candidate.overlaps(network) for network in networks):
            return str(candidate)
    raise VpnError(
        f'no /{NETWORK_PREFIX} of {pool} is free for the VPN',
        f'{POOL_VARIABLE}=10.213.0.0/16 names another range')


def multicast_group(address: str) -> str:
    """
    Return the multicast group of one host, by which other hosts reach all of its participants.

    A VPN interface sends each packet to the one peer that its destination belongs to.

    :param address: the host's VPN address; the VPN's subnet for the range of all groups.
    """
    return f"239.{address.partition('.')[2]}"


def uses_lan_groups(network: str) -> bool:
    """
    Return whether the groups of a VPN's hosts are in 239.255.0.0/16, whose groups LANs use.

    That range (RFC 2365) has the discovery of DDS and of UPnP.

    :param network: a /24 or smaller, in CIDR form.
    """
    return multicast_group(network).startswith('239.255.')


def dds_ports(domain: int) -> tuple[int, int]:
    """
    Return the first and last UDP port of DDS in a ROS domain (RTPS 2.5, 9.6.2.3).

    The range contains multicast discovery (+0) and data (+1), and for each participant i unicast
    discovery (+10 + 2 i) and data (+11 + 2 i), i up to 119. Domain 232 has fewer.
    """
    begin = 7400 + 250 * domain
    return begin, min(begin + 249, 65535)


def overlapping(subnet: str, used: Iterable[str]) -> list[str]:
    """
    Return the networks and addresses in use that overlap a launch's subnet.

    :param used: as for :func:`choose_subnet`.
    """
    ours = _Network(subnet)
    return [text for text in used
            if (network := _network(text)) is not None and network.overlaps(ours)]


def used_networks() -> Command:
    """Return the command that prints a host's networks, for :func:`parse_used`."""
    return Command.script(
        'ip -json -4 route show table all; ip -json -4 addr show',
        what='look at the networks in use')


def parse_used(output: str) -> list[str]:
    """
    Parse the output of :func:`used_networks`, JSON lines, to networks in CIDR form.

    :raises VpnError: the output is not that of ``ip``.
    """
    networks: set[str] = set()
    try:
        for line in output.splitlines():
            for entry in untrusted.parsed(line):
                # an interface that is down has addresses but no routes
                for address in entry.get('addr_info', ()):
                    networks.add(f"{address['local']}/{address['prefixlen']}")
                if 'dst' in entry and entry['dst'] != 'default':
                    networks.add(entry['dst'])
        return sorted(
            str(ipaddress.ip_interface(text).network) for text in networks)
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise VpnError(f"can't read the networks in use: {error}") from error


def choose_port(environment: Mapping[str, str] = {}) -> int:
    """
    Return the robot's UDP port: the environment's, or one that is free on this computer now.

    A free port comes from the ephemeral range, which has no DDS ports of ROS domains 0 to 101.

    :raises ConfigurationError: the environment's value is not a port.
    """
    text = environment.get(PORT_VARIABLE, '').strip()
    if text:
        if not text.isdecimal() or not 0 < int(text) < 65536:
            raise ConfigurationError(f'{PORT_VARIABLE}={text} is no UDP port', 'use 1 to 65535')
        return int(text)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(('', 0))
        port: int = probe.getsockname()[1]
    return port


def own_address(to: tuple[str, int] = ('192.0.2.1', 9)) -> str:
    """
    Return this computer's address on the way to another one.

    :param to: host and port; by default an address that only the default route leads to.
    :raises VpnError: there is no route.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(to)  # sends nothing
        except OSError as error:
            raise VpnError('this computer has no default route, so its address is not known',
                           'name the address: --address') from error
        return str(probe.getsockname()[0])


def _pool(text: str) -> _Network:
    try:
        network = _Network(text)
    except ValueError as error:
        raise ConfigurationError(
            f"'{text}' is no IPv4 network: {error}", f'{POOL_VARIABLE} is like {POOL}') from error
    if network.prefixlen > NETWORK_PREFIX:
        raise ConfigurationError(
            f"'{text}' is smaller than a /{NETWORK_PREFIX}", f'{POOL_VARIABLE} is like {POOL}')
    if network.prefixlen >= 16 and uses_lan_groups(str(network)):
        raise ConfigurationError(
            f"'{text}' has no network for the VPN: its multicast groups would be those of the LAN",
            f'{POOL_VARIABLE} is like {POOL}')
    return network


def _network(text: str) -> _Network | None:
    network = ipaddress.ip_interface(text).network
    if isinstance(network, _Network) and network.prefixlen >= EVERYTHING:
        return network
    return None
