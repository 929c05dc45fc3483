# SPDX-License-Identifier: Apache-2.0
"""
Configure Cyclone DDS, ROS 2's ``rmw_cyclonedds_cpp``, for a robot with a VPN.

Written for 0.10 (ROS 2 Jazzy) and 11: it uses only elements that both accept, and was tested with
both.

A process announces all of its addresses, in the order of its interfaces' priorities. Another host
uses the first address that is not a loopback. So the robot prefers the loopback, where its own
nodes communicate whatever happens to its networks, then its LAN, whose computers use that address,
then the VPN. Machines do not route: they cannot reach the robot's LAN address directly, so they
use the VPN address. A process asks its ``Peers`` from the socket of its first interface, which
cannot reach other hosts from a loopback. So the robot has no peers, and announcements cross the
VPN by multicast (see ``vpn/wireguard.py``), once per interval instead of once per possible port.
They are also sent to each known participant, because participants have no multicast address of
their own. So the traffic of an idle launch grows with the pairs of processes on both sides, and
is inversely proportional to the interval.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
import re
from types import MappingProxyType
from typing import ClassVar, Optional
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.sax.saxutils import quoteattr

from fogros2 import untrusted
from fogros2.dds import check_discovery, DdsVendor, local_only, static_peers
from fogros2.errors import DdsError
from fogros2.model import Command, DdsInterface
from fogros2.vpn import MTU
from fogros2.vpn.addresses import dds_ports

#: Maximum number of ROS 2 processes of a host in a domain, limited by its ports.
MAX_PARTICIPANTS = 119
#: Number of processes that a peer is asked for. Each participant asks each of their ports in each
#: interval, whether or not a process uses the port. An asked process answers, so only two
#: processes that both have higher numbers on their hosts do not find each other. With
#: 32 ports, two idle machines with 3 processes each exchange 31 kB/s instead of 11.
ASKED = 10
#: Seconds between announcements of a participant: how soon a host is found again after its lease
#: ended in a long interruption, or its first announcement was lost. Fifty processes send 210 kB/s.
SPDP_INTERVAL = 3
#: Seconds after which a silent participant is dropped; shorter interruptions need no rediscovery.
LEASE_DURATION = 60
#: NACK_DELAY: milliseconds after which a gap is reported (default 100). Over 10 Mbit/s, 2 ms
#: instead of 5 carry 5 % more raw images, and fewer images are late where packets are lost.
#: HEARTBEAT: milliseconds after which a writer asks whether all samples have arrived (default
#: 100): without a following sample, a lost one is noticed only then. Writers ask only while
#: samples are unacknowledged, less and less often: idle ones send nothing.
NACK_DELAY = 2
HEARTBEAT = 20
#: Requested receive buffer in bytes (a raw 1080p image is 6 MB in one burst). The kernel limits
#: it to its rmem_max; a required minimum above that limit would fail.
RECEIVE_BUFFER = 4 * 1024 * 1024
#: Bytes of a fragment; MESSAGE: of a retransmission: what fits into a packet after IPv4 and UDP
#: (28), RTPS, INFO_DST, INFO_TS and DATA_FRAG (84).
FRAGMENT = MTU - 140
MESSAGE = MTU - 40
#: Settings that hosts have to share, in lower case: their values on machines.
_SHARED: Mapping[str, Sequence[str]] = {
    'transport': ('udp', 'default'), 'spdpmulticastaddress': ('239.255.0.1',), 'tag': (),
    'externaldomainid': ('default',), 'security': (), 'base': ('7400',), 'domaingain': ('250',),
    'participantgain': ('2',), 'multicastmetaoffset': ('0',), 'unicastmetaoffset': ('10',)}
#: FogROS2's own interfaces, and the loopback.
_NOT_LAN = re.compile('lo$|fog')
#: <linux/if.h>
_IFF_MULTICAST = 0x1000
#: A comment or declaration; or a tag, with quotes around > in attributes.
_MARKUP = re.compile(
    r'''<!--.*?-->|<\?.*?\?>|<![^>]*>|<(?P<end>/?)(?P<name>[^\s<>/]*)'''
    r'''(?:[^<>"']|"[^"]*"|'[^']*')*?(?P<empty>/?)>''', re.DOTALL)
#: Attributes about XML itself, some with a prefix that nothing declares.
_NAMESPACE = re.compile(r'''\s(?:xmlns|\w+:\w+)\s*=\s*(?:"[^"]*"|'[^']*')''')


class CycloneDds(DdsVendor):
    """
    Write CYCLONEDDS_URI: local first, then LAN, then VPN; tolerate interruptions of the link.

    :param domain: ROS_DOMAIN_ID, in which peers are asked.
    """

    rmw: ClassVar[str] = 'rmw_cyclonedds_cpp'
    asked_processes: ClassVar[float] = ASKED

    def asked(self, user: Mapping[str, str]) -> list[str]:
        """Return the hosts of ROS_STATIC_PEERS, and those of each ``<Peer>``."""
        return [*static_peers(user), *(
            _attribute(peer, 'address').partition(':')[0] for peer in self._find('peer', user))]

    def ask_lan(self) -> Command:
        """Return the command whose output :meth:`parse_lan` reads."""
        return Command(('ip', '-json', '-4', 'address', 'show', 'up'),
                       what='look at the network interfaces')

    def parse_lan(self, output: str) -> Optional[str]:
        """
        Return the interface that Cyclone uses by default, so that its network stays reachable.

        That is the first one with multicast, in the kernel's order; None if there is none.

        :raises DdsError: the output is not that of ``ip``.
        """
        try:
            for link in untrusted.parsed(output or '[]'):
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
        :param user: the user's environment variables. Interfaces configured there replace the LAN.
            Peers make the LAN come first, because a loopback cannot ask them. If ROS 2 is
            limited to this computer, the LAN is not used, so peers are refused.
        :raises DdsError: the user's configuration cannot be read or extended, or blocks the
            announcements of machines.
        """
        self._check(user)
        has_peers = bool(self._find('peer', user) or user.get('ROS_STATIC_PEERS'))
        listed = self._find('networkinterface', user)
        _check_multicast(listed)
        interfaces = []
        if not any(_attribute(one, 'name') == 'lo' or _attribute(one, 'address').startswith('127.')
                   for one in listed):
            interfaces.append(DdsInterface('lo', -5 if has_peers else 20))
        if local_only(user) and not listed and any(
                not host.startswith('127.') and host != 'localhost' for host in self.asked(user)):
            raise DdsError(
                'ROS 2 is limited to this computer, so the nodes of Cyclone DDS do not use the '
                "LAN and would not meet those of ROS_STATIC_PEERS or CYCLONEDDS_URI's Peers",
                'use rmw_fastrtps_cpp, leave the peers out, or unset '
                'ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_LOCALHOST_ONLY')
        if lan is not None and not listed and not local_only(user):
            interfaces.append(DdsInterface(lan, 10, required=False))
        # below 0, the default priority of the user's own interfaces
        return [*interfaces, DdsInterface(vpn, -10, required=False)]

    def _check(self, user: Mapping[str, str]) -> None:
        """Refuse settings with which the robot's nodes would not meet those of machines."""
        if self._find('networkinterfaceaddress', user):
            raise DdsError(
                "CYCLONEDDS_URI's NetworkInterfaceAddress excludes the VPN",
                'write <Interfaces><NetworkInterface name="..."/></Interfaces> instead')
        if any((one.text or '').strip().lower() == 'false'
               for one in self._find('allowmulticast', user)[-1:]):
            raise DdsError(
                "CYCLONEDDS_URI's AllowMulticast is false, but the robot's nodes and those of "
                'machines discover each other by multicast', 'write spdp instead of false')
        for tag, values in _SHARED.items():
            for one in self._find(tag, user)[-1:]:
                text = ''.join(one.itertext()).strip().lower()
                if text and text not in values:
                    raise DdsError(
                        f'CYCLONEDDS_URI sets {one.tag}, which is '
                        f"{values[0] if values else 'not set'} on machines: the robot's nodes "
                        'would not meet those of machines', f'leave {one.tag} out')

    def _find(self, tag: str, user: Mapping[str, str]) -> list[Element]:
        """Return the user's settings with a tag, in lower case, that are for our domain."""
        elements: list[Element] = []
        for _, root in fragments(user.get('CYCLONEDDS_URI', ''), user):
            # Cyclone accepts <Domain> and its settings without what is around them
            for part in root if root.tag.lower() == 'cyclonedds' else [root]:
                if part.tag.lower() != 'domain' or _attribute(part, 'id').lower() in (
                        '', 'any', str(self.domain)):
                    elements += [one for one in part.iter() if one.tag.lower() == tag]
        return elements

    def machine_interfaces(self, vpn: str) -> list[DdsInterface]:
        """Return the interfaces of a machine's nodes; their peers are the other machines."""
        return [DdsInterface(vpn, 10, required=False), DdsInterface('lo')]

    def render(
        self, interfaces: Sequence[DdsInterface], peers: Sequence[str],
        user: Mapping[str, str] = MappingProxyType({}), *, quiet: bool = False,
    ) -> str:
        """
        Return the XML; the user's own configuration stays separate, see :meth:`environment`.

        :param peers: ignored if the preferred interface is a loopback, which cannot ask them.
        """
        ordered = sorted(interfaces, key=lambda interface: -interface.priority)
        networks = [interface for interface in interfaces if interface.name != 'lo']
        hosts = list(dict.fromkeys(peers)) if ordered[0] in networks else []
        return '\n'.join([
            '<?xml version="1.0" encoding="UTF-8"?>',
            '<CycloneDDS xmlns="https://cdds.io/config">',
            '  <Domain Id="any">',
            '    <General>',
            '      <Interfaces>',
            *(f'        {_interface(interface)}' for interface in ordered),
            '      </Interfaces>',
            # multicast for announcements only: data is sent to matching participants
            '      <AllowMulticast>spdp</AllowMulticast>',
            '      <MulticastRecvNetworkInterfaceAddresses>all'
            '</MulticastRecvNetworkInterfaceAddresses>',
            # machines: addresses outside the VPN's subnet, as in the robot's LAN, are unreachable
            *_if(len(networks) == 1 and ordered[0] in networks,
                 '      <DontRoute>true</DontRoute>'),
            f'      <MaxRexmitMessageSize>{MESSAGE} B</MaxRexmitMessageSize>',
            f'      <FragmentSize>{FRAGMENT} B</FragmentSize>',
            '    </General>',
            '    <Discovery>',
            # a predictable port: machines are asked by unicast
            '      <ParticipantIndex>auto</ParticipantIndex>',
            f'      <MaxAutoParticipantIndex>{MAX_PARTICIPANTS}</MaxAutoParticipantIndex>',
            f'      <SPDPInterval>{SPDP_INTERVAL} s</SPDPInterval>',
            f'      <LeaseDuration>{LEASE_DURATION} s</LeaseDuration>',
            *_if(bool(hosts), '      <Peers>'),
            *(f'        <Peer address={quoteattr(address)}/>'
              for host in hosts for address in self._addresses(host)),
            *_if(bool(hosts), '      </Peers>'),
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
        begin, _ = dds_ports(self.domain)
        return [f'{host}:{begin + 10 + 2 * index}' for index in range(ASKED)]

    def environment(self, path: str, user: Mapping[str, str]) -> Mapping[str, str]:
        """
        Return RMW_IMPLEMENTATION and CYCLONEDDS_URI: the user's fragments, then our file.

        Cyclone reads them in order, and the last value of a setting wins; interfaces and peers add
        up.

        :param path: absolute path of our file.
        :raises DdsError: the user's environment disables discovery, or the path contains a comma.
        """
        check_discovery(user)
        if ',' in path:
            raise DdsError(f'Cyclone DDS reads {path} as two files', 'use a path without a comma')
        # Cyclone opens the path after file:// without decoding it
        ours = f'file://{path}'
        theirs = closed(user.get('CYCLONEDDS_URI', '').strip().rstrip(','))
        if theirs.endswith(ours):
            uri = theirs
        else:
            uri = f'{theirs},{ours}' if theirs else ours
        return {'RMW_IMPLEMENTATION': self.rmw, 'CYCLONEDDS_URI': uri}


def fragments(
    uri: str, variables: Mapping[str, str] = MappingProxyType({}),
) -> Iterator[tuple[str, Element]]:
    """
    Yield each part of a CYCLONEDDS_URI: its path, or the begin of inline text; and its element.

    :param variables: values of variables in the XML, such as ``${INTERFACE}``.
    :raises DdsError: a file cannot be read, or a part is no XML.
    """
    def value(match: re.Match[str]) -> str:
        return variables.get(match[1]) or match[2] or ''

    for place, text in _parts(uri):
        try:
            yield place, ElementTree.fromstring(
                re.sub(r'\$\{(\w+)(?::-([^}]*))?\}', value, text))
        except ElementTree.ParseError as error:
            raise DdsError(f'{place} of CYCLONEDDS_URI is no XML: {error}',
                           'nodes would refuse to start; correct or unset CYCLONEDDS_URI'
                           ) from error


def _parts(uri: str) -> Iterator[tuple[str, str]]:
    """Yield each part of a CYCLONEDDS_URI as Cyclone splits it: its place and its XML."""
    rest = uri.strip(' ,\n\t')
    while rest:
        if rest.startswith('<'):
            begin = rest[:60]
            xml, _, rest = _element(rest)
            yield f'{begin}...', xml
        else:
            name, _, rest = rest.partition(',')
            path = Path(name.removeprefix('file://'))
            try:
                yield str(path), _MARKUP.sub(
                    lambda tag: _NAMESPACE.sub('', tag[0]), path.read_text(errors='replace'))
            except OSError as error:
                raise DdsError(
                    f"CYCLONEDDS_URI names {path}, which can't be read: {error.strerror}",
                    'nodes would refuse to start; correct or unset CYCLONEDDS_URI') from error
        rest = rest.strip(' ,\n\t')


def _element(text: str) -> tuple[str, str, str]:
    """
    Return the first element of inline text as XML, its missing end, and the text behind it.

    There, Cyclone takes ``</>`` for the end of any element, and the end of the text for all ends.
    """
    xml, names, at = '', list[str](), 0
    for tag in _MARKUP.finditer(text):
        xml += text[at:tag.start()]
        at = tag.end()
        if tag['name'] is None:
            continue  # a comment, or the declaration
        if tag['end']:
            xml += f"</{tag['name'] or ''.join(names[-1:])}>"
            names = names[:-1]
        else:
            xml += _NAMESPACE.sub('', tag[0])
            names += [] if tag['empty'] else [tag['name']]
        if not names:
            return xml, '', text[at:]
    missing = ''.join(f'</{name}>' for name in reversed(names))
    return xml + text[at:] + missing, missing, ''


def closed(uri: str) -> str:
    """Return a CYCLONEDDS_URI behind which Cyclone reads more: inline XML has its end."""
    rest = uri
    while (begin := re.search(r'(^|,)[\s,]*<', rest)) is not None:
        _, missing, rest = _element(rest[begin.end() - 1:])
        if missing:
            return uri + missing
    return uri


def _attribute(element: Element, name: str) -> str:
    """Return an attribute, whose name Cyclone reads in any case; '' if it is missing."""
    return next((value for key, value in element.items() if key.lower() == name), '')


def _check_multicast(listed: Sequence[Element]) -> None:
    """
    Refuse a user's interface that disables multicast on all interfaces.

    Cyclone 0.10 (ROS 2 Jazzy) then disables multicast for the whole process, and machines are
    found by multicast.

    :param listed: each ``<NetworkInterface>``.
    """
    for one in listed:
        name, multicast = _attribute(one, 'name'), _attribute(one, 'multicast').lower()
        if multicast == 'false' or name and multicast != 'true' and not _has_multicast(name):
            own = ''.join(f'{key}="{value}" ' for key, value in one.items()
                          if key.lower() != 'multicast')
            raise DdsError(
                'CYCLONEDDS_URI makes nodes use '
                f"{name or _attribute(one, 'address') or 'an interface'} without multicast, so "
                'they would discover no machine',
                f'write <NetworkInterface {own}multicast="true"/>')


def _has_multicast(interface: str) -> bool:
    try:
        flags = Path('/sys/class/net', interface, 'flags').read_text()
    except (OSError, ValueError):  # ValueError: no file has this name
        return True  # Cyclone itself reports a missing interface
    return bool(int(flags, 16) & _IFF_MULTICAST)


def _interface(interface: DdsInterface) -> str:
    required = 'true' if interface.required else 'false'
    return (f'<NetworkInterface name={quoteattr(interface.name)} multicast="true"'
            f' priority="{interface.priority}" presence_required="{required}"/>')


def _if(condition: bool, line: str) -> list[str]:
    return [line] if condition else []
