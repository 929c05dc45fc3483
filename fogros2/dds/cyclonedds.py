# SPDX-License-Identifier: Apache-2.0
"""
Cyclone DDS, ROS 2's ``rmw_cyclonedds_cpp``: its configuration for a robot with a VPN.

Written for 0.10 (ROS 2 Jazzy) and 11: only elements that both know, and all of it tried with both.

A process announces every address it has, in the order of its interfaces' priorities, and another
host takes the first that isn't a loopback. So the robot prefers the loopback (its own nodes talk
there whatever becomes of its networks), then its LAN (whose other computers send to it there),
then the VPN. Machines don't route: the robot's LAN address isn't reachable directly from them,
so they take the VPN's. A process asks its ``Peers`` from the socket of its first interface, which
leads nowhere from a loopback: the robot has none, and announcements cross the VPN by multicast
(see ``vpn/wireguard.py``), once in an interval rather than once per port that may be in use. They
go to each participant that is known, too, as those have no multicast address of their own: what
an idle launch sends grows with the pairs of processes here and there; the interval divides it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import ipaddress
import json
from pathlib import Path
import re
from types import MappingProxyType
from typing import ClassVar, Optional
from xml.sax.saxutils import quoteattr

from fogros2.dds import DdsVendor, is_address
from fogros2.errors import DdsError
from fogros2.model import Command, DdsInterface

#: ROS 2 processes that a host can have in a domain, as its ports allow.
MAX_PARTICIPANTS = 119
#: Of these, how many a peer is asked for: each has a port, which each participant asks in each
#: interval, whether anything runs there or not. Who is asked answers, so only two processes that
#: both come later than that on their hosts don't find each other.
ASKED = 10
#: RTPS 2.5, 9.6.2.3: participant i of a domain is asked at 7410 + 250 * domain + 2 * i.
PORT_BASE = 7410
PORTS_PER_DOMAIN = 250
#: Seconds between a participant's announcements: how soon a host is found again whose lease
#: ended in a long cut, or whose first one was lost. Fifty processes send 210 kB/s by it.
SPDP_INTERVAL = 3
#: Seconds a silent participant is kept: what a cut may last without being discovered anew.
LEASE_DURATION = 60
#: Milliseconds after which a gap is reported, rather than 100: what comes out of order over a VPN
#: is less late than that. And after which a writer asks whether all has come, 100 as well by
#: default: with nothing behind it, a lost message is missed no sooner. Writers ask only as long as
#: something isn't acknowledged, less and less often, so idle ones stay silent.
NACK_DELAY = 5
HEARTBEAT = 20
#: Bytes of receive buffer asked for (a raw 1080p image is 6 MB, sent in one burst); the kernel
#: gives what its rmem_max allows, and asking for a minimum would fail there.
RECEIVE_BUFFER = 4 * 1024 * 1024
#: Bytes of one fragment, of a retransmission, and of a message where all of them cross the VPN:
#: what fits into 1420 bytes after IPv4 and UDP (28), RTPS, INFO_DST, INFO_TS and DATA_FRAG (84).
FRAGMENT = 1280
MESSAGE = 1380
LOOPBACK = '127.0.0.1'
#: Interfaces of FogROS2's own, and the loopback.
_NOT_LAN = re.compile('lo$|fog')
#: <linux/if.h>
_IFF_MULTICAST = 0x1000


class CycloneDds(DdsVendor):
    """
    Renders CYCLONEDDS_URI: local first, then LAN, then VPN; patient with a link that is cut.

    :param domain: ROS_DOMAIN_ID, in which peers are asked.
    """

    rmw: ClassVar[str] = 'rmw_cyclonedds_cpp'

    def ask_lan(self) -> Command:
        """Return the command whose output :meth:`parse_lan` reads."""
        return Command(('ip', '-json', '-4', 'address', 'show', 'up'),
                       what='look at the network interfaces')

    def parse_lan(self, output: str) -> Optional[str]:
        """
        Return the interface that Cyclone takes by itself, so that what it reaches stays in reach.

        That is the first one that can multicast, in the kernel's order; None where there is none.

        :raises DdsError: it isn't what ``ip`` prints.
        """
        try:
            for link in json.loads(output or '[]'):
                name, flags = link.get('ifname', ''), link.get('flags', ())
                if (link.get('addr_info') and 'MULTICAST' in flags
                        and 'POINTOPOINT' not in flags and not _NOT_LAN.match(name)):
                    return str(name)
        except (ValueError, AttributeError, TypeError) as error:
            raise DdsError(f"can't read the network interfaces: {error}") from error
        return None

    def robot_interfaces(
        self, vpn: str, lan: Optional[str], user: Mapping[str, str],
    ) -> list[DdsInterface]:
        """
        Return the interfaces of the robot's nodes, which get no peers.

        :param lan: see :meth:`parse_lan`.
        :param user: the environment as the user has it; interfaces configured there are used in
            the LAN's place, peers make the LAN come first, or they couldn't be asked, and who
            keeps ROS 2 to this computer has no LAN.
        :raises DdsError: the user's configuration can't be read, can't be added to, or lets no
            announcement of a machine in.
        """
        text = ''.join(_fragments(user.get('CYCLONEDDS_URI', '')))
        if '<NetworkInterfaceAddress' in text:
            raise DdsError(
                "CYCLONEDDS_URI's NetworkInterfaceAddress leaves no place for the VPN",
                'write <Interfaces><NetworkInterface name="..."/></Interfaces> instead')
        if user.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() == 'LOCALHOST':
            # the user keeps to this computer: to it and its machines, then
            lan = None
        has_peers = bool(re.search(r'<Peer\b', text) or user.get('ROS_STATIC_PEERS'))
        listed = re.findall(r'<NetworkInterface\b([^>]*)>', text)
        _check_multicast(listed)
        interfaces = []
        if not any(re.search(r'"lo"|"127\.', attributes) for attributes in listed):
            interfaces.append(DdsInterface('lo', -5 if has_peers else 20, multicast=True))
        local = (user.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() == 'LOCALHOST'
                 or user.get('ROS_LOCALHOST_ONLY') == '1')
        if lan is not None and not listed and not local:
            interfaces.append(DdsInterface(lan, 10, required=False, multicast=True))
        # below 0, which is what an interface has whose priority the user didn't think of
        return [*interfaces, DdsInterface(vpn, -10, required=False, multicast=True)]

    def machine_interfaces(self, vpn: str) -> list[DdsInterface]:
        """Return the interfaces of a machine's nodes; their peers are the other machines."""
        return [DdsInterface(vpn, 10, required=False, multicast=True),
                DdsInterface('lo', multicast=True)]

    def render(
        self, interfaces: Sequence[DdsInterface], peers: Sequence[str],
        user: Mapping[str, str] = MappingProxyType({}),
    ) -> str:
        """
        Return the XML; the user's own comes beside it, see :meth:`environment`.

        :param peers: left out where the preferred interface is a loopback, which can't ask them.
        :raises DdsError: no interface.
        """
        if not interfaces:
            raise DdsError('Cyclone DDS needs a network interface',
                           'ip link shows those there are')
        ordered = sorted(interfaces, key=lambda interface: -interface.priority)
        multicast = any(interface.multicast for interface in interfaces)
        networks = [interface for interface in interfaces if not _is_loopback(interface)]
        asked = [] if _is_loopback(ordered[0]) and networks else list(dict.fromkeys(peers))
        if not multicast:
            asked.insert(0, LOOPBACK)
        return '\n'.join([
            '<?xml version="1.0" encoding="UTF-8"?>',
            '<CycloneDDS xmlns="https://cdds.io/config">',
            '  <Domain Id="any">',
            '    <General>',
            '      <Interfaces>',
            *(f'        {_interface(interface)}' for interface in ordered),
            '      </Interfaces>',
            # announcements alone: data goes to whom it matches, and no further
            f'      <AllowMulticast>{"spdp" if multicast else "false"}</AllowMulticast>',
            *_if(multicast, '      <MulticastRecvNetworkInterfaceAddresses>all'
                            '</MulticastRecvNetworkInterfaceAddresses>'),
            # machines: what isn't on the VPN's subnet, such as the robot's LAN, is out of reach
            *_if(len(networks) == 1 and ordered[0] in networks,
                 '      <DontRoute>true</DontRoute>'),
            # the size holds for the whole process: small only where nothing big stays on the host
            *_if(len(interfaces) == len(networks) == 1,
                 f'      <MaxMessageSize>{MESSAGE} B</MaxMessageSize>'),
            f'      <MaxRexmitMessageSize>{MESSAGE} B</MaxRexmitMessageSize>',
            f'      <FragmentSize>{FRAGMENT} B</FragmentSize>',
            '    </General>',
            '    <Discovery>',
            # a port that others can know: machines are asked by unicast
            '      <ParticipantIndex>auto</ParticipantIndex>',
            f'      <MaxAutoParticipantIndex>{MAX_PARTICIPANTS}</MaxAutoParticipantIndex>',
            f'      <SPDPInterval>{SPDP_INTERVAL} s</SPDPInterval>',
            f'      <LeaseDuration>{LEASE_DURATION} s</LeaseDuration>',
            *_if(bool(asked), '      <Peers>'),
            *(f'        <Peer address={quoteattr(address)}/>'
              for host in asked for address in self._addresses(host)),
            *_if(bool(asked), '      </Peers>'),
            '    </Discovery>',
            '    <Internal>',
            f'      <SocketReceiveBufferSize max="{RECEIVE_BUFFER} B"/>',
            f'      <NackDelay>{NACK_DELAY} ms</NackDelay>',
            f'      <HeartbeatInterval min="{HEARTBEAT // 4} ms" minsched="{HEARTBEAT // 2} ms"'
            f' max="1 s">{HEARTBEAT} ms</HeartbeatInterval>',
            '    </Internal>',
            '  </Domain>',
            '</CycloneDDS>',
            ''])

    def _addresses(self, host: str) -> list[str]:
        begin = PORT_BASE + PORTS_PER_DOMAIN * self.domain
        # it costs no network to ask more of this host
        count = 4 * ASKED if host == LOOPBACK else ASKED
        return [f'{host}:{port}' for port in range(begin, begin + 2 * count, 2)]

    def environment(self, path: str, user: Mapping[str, str]) -> Mapping[str, str]:
        """
        Return RMW_IMPLEMENTATION and CYCLONEDDS_URI: the user's fragments, then our file.

        Cyclone reads them in order and the last word on a setting counts; interfaces and peers
        add up.

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


def _fragments(uri: str) -> Iterator[str]:
    """Yield the XML of each part of a CYCLONEDDS_URI: inline, or the file that it names."""
    rest = uri.strip(' ,\n\t')
    while rest:
        if rest.startswith('<'):
            inline, end, rest = rest.partition('</CycloneDDS>')
            yield inline + end
        else:
            name, _, rest = rest.partition(',')
            path = Path(name.removeprefix('file://'))
            try:
                yield path.read_text()
            except OSError as error:
                raise DdsError(
                    f"CYCLONEDDS_URI names {path}, which can't be read: {error.strerror}",
                    'nodes would refuse to start; correct or unset CYCLONEDDS_URI') from error
        rest = rest.strip(' ,\n\t')


def _check_multicast(listed: Sequence[str]) -> None:
    """
    Refuse an interface of the user's that takes multicast from all the others.

    Cyclone 0.10, which ROS 2 Jazzy has, turns it off for the whole process then, and with it what
    machines are found by.

    :param listed: the attributes of each ``<NetworkInterface>``.
    """
    for attributes in listed:
        name = re.search(r'\bname="([^"]*)"', attributes)
        if name and 'multicast="true"' not in attributes and not _has_multicast(name[1]):
            raise DdsError(
                f'CYCLONEDDS_URI has nodes use {name[1]}, which knows no multicast: they would'
                ' hear of no machine',
                f'write <NetworkInterface name="{name[1]}" multicast="true"/>')


def _has_multicast(interface: str) -> bool:
    try:
        flags = Path('/sys/class/net', interface, 'flags').read_text()
    except OSError:
        return True  # Cyclone has its own word on one that isn't there
    return bool(int(flags, 16) & _IFF_MULTICAST)


def _interface(interface: DdsInterface) -> str:
    attribute = 'address' if is_address(interface.name) else 'name'
    return (
        f'<NetworkInterface {attribute}={quoteattr(interface.name)}'
        f' priority="{interface.priority}" multicast="{_boolean(interface.multicast)}"'
        f' presence_required="{_boolean(interface.required)}"/>')


def _if(condition: bool, line: str) -> list[str]:
    return [line] if condition else []


def _boolean(value: bool) -> str:
    return 'true' if value else 'false'


def _is_loopback(interface: DdsInterface) -> bool:
    if is_address(interface.name):
        return ipaddress.ip_address(interface.name).is_loopback
    return interface.name == 'lo'
