# SPDX-License-Identifier: Apache-2.0
"""What guests have of a launch's VPN: their addresses and ports, and the machine's filter."""

from __future__ import annotations

from collections.abc import Sequence
import ipaddress

from fogros2.model import VpnInterface
from fogros2.vpn.addresses import DISCOVERY_GROUP, FIRST_FREE, multicast_group

#: TCP port of a machine on its VPN address at which guests' robots reach their accounts.
PORT = 7399
#: Number of a guest's UDP port for heartbeats, beside DDS's, less the last byte of its address.
_HEARTBEATS = 7000


def guests(subnet: str) -> ipaddress.IPv4Network:
    """Return the range of a launch's subnet that is for guests."""
    return ipaddress.IPv4Network((int(ipaddress.IPv4Network(subnet)[FIRST_FREE]), 27))


def heartbeats(address: str) -> int:
    """Return the UDP port of a machine's VPN address for the heartbeats of one guest."""
    return _HEARTBEATS + ipaddress.IPv4Address(address).packed[3]


def rules(interface: VpnInterface, ports: Sequence[tuple[int, int]]) -> str:
    """
    Return the rules for ``nft`` by which guests reach a machine's DDS, ping and door alone.

    They are a table of their own, beside the one of the VPN; an accept overrides no drop there.

    :param ports: ranges of UDP ports of DDS, as (first, last).
    """
    name, own = interface.name, guests(interface.network)
    known = ', '.join(f'{guest} . {heartbeats(str(guest))}' for guest in own)
    admitted = f'iifname "{name}" ip saddr {own}'
    groups = f'{DISCOVERY_GROUP}, {multicast_group(interface.address)}'
    return f"""\
table inet {name}g
delete table inet {name}g
table inet {name}g {{
  chain guests {{
    ip daddr != {{ {interface.address}, {groups} }} drop
    udp dport {{ {', '.join(f'{first}-{last}' for first, last in ports)} }} accept
    icmp type echo-request accept
    tcp dport {PORT} accept
    ip saddr . udp dport {{ {known} }} accept
    drop
  }}
  chain input {{
    type filter hook input priority filter; policy accept;
    {admitted} goto guests
  }}
  chain forward {{
    type filter hook forward priority filter; policy accept;
    {admitted} drop
  }}
}}
"""
