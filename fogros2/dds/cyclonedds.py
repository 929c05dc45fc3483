# SPDX-License-Identifier: Apache-2.0
"""
Cyclone DDS, ROS 2's ``rmw_cyclonedds_cpp``: its configuration for a robot with a VPN.

Written for 0.10 (ROS 2 Jazzy) and 11: only elements that both know.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import ipaddress
from typing import ClassVar
from xml.sax.saxutils import quoteattr

from fogros2.dds import DdsVendor
from fogros2.errors import DdsError
from fogros2.model import DdsInterface

#: ROS 2 processes that one host can have in a domain, and ports asked for at each peer: every
#: participant asks every one of them again in each SPDP interval, so it costs bandwidth while
#: nothing runs there. 32 is what Jazzy's rmw sets for itself.
MAX_PARTICIPANTS = 32
#: Seconds between a participant's announcements: how soon a host is found again whose lease
#: ended in a long cut, or that came up after the nodes.
SPDP_INTERVAL = 1
#: Seconds a silent participant is kept: what a cut may last without being discovered anew.
LEASE_DURATION = 60
#: Bytes of receive buffer asked for (a raw 1080p image is 6 MB, sent in one burst); the kernel
#: gives what its rmem_max allows, and asking for a minimum would fail there.
RECEIVE_BUFFER = 4 * 1024 * 1024
#: Bytes of one fragment, of a retransmission, and of a message where all of them cross the VPN:
#: what fits into 1420 bytes after IPv4 and UDP (28), RTPS, INFO_DST, INFO_TS and DATA_FRAG (84).
FRAGMENT = 1280
MESSAGE = 1380
LOOPBACK = '127.0.0.1'


class CycloneDds(DdsVendor):
    """Renders CYCLONEDDS_URI: VPN first, unicast peers, patient with a link that is cut."""

    rmw: ClassVar[str] = 'rmw_cyclonedds_cpp'

    def render(self, interfaces: Sequence[DdsInterface], peers: Sequence[str]) -> str:
        """
        Return the XML.

        :raises DdsError: no interface.
        """
        if not interfaces:
            raise DdsError('Cyclone DDS needs a network interface')
        ordered = sorted(interfaces, key=lambda interface: -interface.priority)
        multicast = any(interface.multicast for interface in interfaces)
        # the size holds for the whole process: small only where nothing big stays on the host
        small = len(interfaces) == 1 and not _is_loopback(interfaces[0])
        addresses = list(dict.fromkeys([LOOPBACK, *peers]))
        return '\n'.join([
            '<?xml version="1.0" encoding="UTF-8"?>',
            '<CycloneDDS xmlns="https://cdds.io/config">',
            '  <Domain Id="any">',
            '    <General>',
            '      <Interfaces>',
            *(f'        {_interface(interface)}' for interface in ordered),
            '      </Interfaces>',
            f'      <AllowMulticast>{_boolean(multicast)}</AllowMulticast>',
            *([f'      <MaxMessageSize>{MESSAGE} B</MaxMessageSize>'] if small else []),
            f'      <MaxRexmitMessageSize>{MESSAGE} B</MaxRexmitMessageSize>',
            f'      <FragmentSize>{FRAGMENT} B</FragmentSize>',
            '    </General>',
            '    <Discovery>',
            '      <ParticipantIndex>auto</ParticipantIndex>',
            f'      <MaxAutoParticipantIndex>{MAX_PARTICIPANTS}</MaxAutoParticipantIndex>',
            f'      <SPDPInterval>{SPDP_INTERVAL} s</SPDPInterval>',
            f'      <LeaseDuration>{LEASE_DURATION} s</LeaseDuration>',
            '      <Peers>',
            *(f'        <Peer address={quoteattr(address)}/>' for address in addresses),
            '      </Peers>',
            '    </Discovery>',
            '    <Internal>',
            f'      <SocketReceiveBufferSize max="{RECEIVE_BUFFER} B"/>',
            '    </Internal>',
            '  </Domain>',
            '</CycloneDDS>',
            ''])

    def environment(self, path: str, user: Mapping[str, str]) -> Mapping[str, str]:
        """
        Return RMW_IMPLEMENTATION and CYCLONEDDS_URI: the user's fragments, then our file.

        Cyclone reads them in order and the last word on a setting counts; peers add up.

        :param path: absolute.
        :raises DdsError: the user's environment turns discovery off, or the path has a comma.
        """
        if user.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() == 'OFF':
            raise DdsError(
                'ROS_AUTOMATIC_DISCOVERY_RANGE is OFF, so no node would find another',
                'unset ROS_AUTOMATIC_DISCOVERY_RANGE')
        if ',' in path:
            raise DdsError(f'Cyclone DDS reads {path} as two files', 'use a path without a comma')
        # Cyclone opens what follows file:// as it is, without decoding
        ours = f'file://{path}'
        theirs = user.get('CYCLONEDDS_URI', '').strip().rstrip(',')
        if theirs.endswith(ours):
            uri = theirs
        else:
            uri = f'{theirs},{ours}' if theirs else ours
        return {'RMW_IMPLEMENTATION': self.rmw, 'CYCLONEDDS_URI': uri}


def _interface(interface: DdsInterface) -> str:
    attribute = 'address' if _is_address(interface.name) else 'name'
    return (
        f'<NetworkInterface {attribute}={quoteattr(interface.name)}'
        f' priority="{interface.priority}" multicast="{_boolean(interface.multicast)}"'
        f' presence_required="{_boolean(interface.required)}"/>')


def _boolean(value: bool) -> str:
    return 'true' if value else 'false'


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _is_loopback(interface: DdsInterface) -> bool:
    if _is_address(interface.name):
        return ipaddress.ip_address(interface.name).is_loopback
    return interface.name == 'lo'
