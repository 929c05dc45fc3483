# SPDX-License-Identifier: Apache-2.0
"""
Configure Fast DDS, ROS 2's ``rmw_fastrtps_cpp``, for a robot with a VPN.

Written for 2.14 (ROS 2 Jazzy). 2.9 reads the profile too, but does not know ``netmask_filter``.

A process announces all of its addresses, and others send to all of them. So the robot keeps all of
its interfaces, with the VPN's as one of them, and other computers on its LAN work as before. A
machine uses only the VPN interface, and sends only to addresses of that network: packets to the
robot's LAN would leave the machine unencrypted.

Discovery uses multicast. WireGuard sends a packet to the one peer that its destination belongs to,
so each host has a group of its own (``vpn.addresses``), to which the others send announcements and
descriptions of topics. One packet is for all processes of the host. By unicast each process would
send each of them to each process: the traffic of 100 processes would be ten times as much. Only
the robot also listens to the common group, for its LAN, unless it is limited to itself or the
user's profile has no multicast. In another robot's VPN it announces no group: it may be in
several, with an address in each. Processes that use the default announce none either.

Nodes use UDP only. Shared memory, which Fast DDS uses by default, carries nothing between two
accounts, or between containers with a common network, and reports no error: the segments of one
account are 0644. Each account could also read all topics in them. With a large receive buffer
UDP is as fast; without one, both wait for lost fragments of images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
import re
from types import MappingProxyType
from typing import ClassVar, Optional
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from fogros2.dds import addresses_of, check_discovery, DdsVendor, local_only, static_peers
from fogros2.errors import DdsError
from fogros2.model import DdsInterface
from fogros2.store import check_owner
from fogros2.vpn import MTU
from fogros2.vpn.addresses import dds_ports, DISCOVERY_GROUP, multicast_group

#: Environment variable with the path of Fast DDS's profiles.
VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
#: File that Fast DDS reads in the working directory.
DEFAULT_FILE = 'DEFAULT_FASTRTPS_PROFILES.xml'
NAMESPACE = 'http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles'
#: Number of processes that a host without multicast is asked for; ROS 2 asks as many.
ASKED = 32
#: Seconds between announcements of a participant, which are sent to each known participant: the
#: traffic grows with the square of their number.
ANNOUNCEMENT = 3
#: Seconds after which a silent participant is dropped; shorter interruptions need no rediscovery.
LEASE_DURATION = 60
#: Requested receive buffer in bytes; the kernel limits it to its rmem_max.
RECEIVE_BUFFER = 4 * 1024 * 1024
#: Bytes of a datagram: seven packets of the VPN (1256 bytes each after IPv4, less UDP's 8). The
#: default of 65500 is lost with any of its 53 packets: at 5 % loss, no message of 20 kB arrives.
#: Smaller ones cost processor time for large images. It is a property of writers, because a
#: transport with a smaller size could not receive the datagrams of others.
DATAGRAM = 7 * ((MTU - 20) // 8 * 8) - 8
#: Milliseconds after which a writer asks whether all samples have arrived (default 3000): without
#: a following sample, a lost one is noticed only then. Writers ask only while samples are
#: unacknowledged.
HEARTBEAT = 200
#: Milliseconds before a writer answers a report of losses (default 5; in Cyclone DDS, the reader
#: waits as long). It answers each report, also while its last answer is in the queue of a slow
#: link: with 5 ms, a raw VGA image at 10 Mbit/s becomes 8 MB/s of repeats and never arrives.
ANSWER = 100
#: Topic of the middleware with the names of a process's nodes.
NODE_NAMES = 'ros_discovery_info'
#: Number of stored addresses of another participant. The default is 4, and a robot with containers
#: easily has more; the VPN's, one of its newest, would be dropped.
KEPT_ADDRESSES = 32
LOOPBACK = '127.0.0.1'
#: Stands for all interfaces.
ANY = '0.0.0.0'
#: Values of FASTDDS_BUILTIN_TRANSPORTS that can reach nodes with UDP only.
_REACHABLE = ('', 'DEFAULT', 'UDPV4')
#: Settings of the default participant that are refused: where in ``<rtps>``, the values that do
#: not matter, and what follows from others.
_REFUSED: Sequence[tuple[str, Sequence[str], str]] = (
    ('userTransports/transport_id', (), 'exclude the VPN'),
    ('useBuiltinTransports', ('true', '1'), 'exclude the VPN'),
    ('builtinTransports', ('DEFAULT', 'UDPv4'), 'have no plain UDP, which machines use'),
    ('builtin/discovery_config/discoveryProtocol', ('SIMPLE',),
     'discover by a server that no machine knows'),
    ('builtin/discovery_config/ignoreParticipantFlags', ('NO_FILTER', 'FILTER_SAME_PROCESS'),
     'ignore other hosts'),
    ('builtin/metatrafficUnicastLocatorList//address', (), 'have no address in the VPN'),
    ('defaultUnicastLocatorList//address', (), 'have no address in the VPN'),
    ('port/portBase', ('7400',), 'have other ports than those of machines'))
_PEER = re.compile(r'[A-Za-z0-9][A-Za-z0-9._-]*')
_UDP = 'fogros2_udp'


class FastDds(DdsVendor):
    """
    Write a profile for every participant: all interfaces, or the VPN only.

    :param domain: ROS_DOMAIN_ID, in which peers are asked.
    """

    rmw: ClassVar[str] = 'rmw_fastrtps_cpp'
    by_address: ClassVar[bool] = True
    asks_machines: ClassVar[bool] = True

    @property
    def ports(self) -> Sequence[tuple[int, int]]:
        """
        The ranges of UDP ports on which the robot's nodes listen.

        At those of the second, each process receives the node lists of others
        (``ros_discovery_info``), in every domain: the middleware itself sets the port.
        """
        return [*super().ports, (7000, 7119)]

    def asked(self, user: Mapping[str, str]) -> list[str]:
        """Return the hosts of ROS_STATIC_PEERS, and those of the user's profiles."""
        root, _ = _profiles(_file(user))
        return [*static_peers(user), *(
            (address.text or '').strip() for address in root.iter('address'))]

    def robot_interfaces(
        self, vpn: str, lan: Optional[str], user: Mapping[str, str],
    ) -> list[DdsInterface]:
        """
        Return the interfaces of the robot's nodes: all of them, and the VPN's.

        If ROS 2 is limited to this computer, they use the loopback, unless they have peers.

        :raises DdsError: the user's environment prevents communication with machines.
        """
        if user.get('ROS_DISCOVERY_SERVER'):
            raise DdsError(
                'ROS_DISCOVERY_SERVER makes nodes use only a server that no machine knows',
                'unset ROS_DISCOVERY_SERVER, or use rmw_cyclonedds_cpp')
        transports = user.get('FASTDDS_BUILTIN_TRANSPORTS', '')
        if transports.upper() not in _REACHABLE:
            raise DdsError(
                f'with FASTDDS_BUILTIN_TRANSPORTS={transports}, nodes would reach no machine',
                'unset it: machines speak UDP over IPv4')
        # a loopback cannot ask peers
        first = LOOPBACK if local_only(user) and not static_peers(user) else ANY
        return [DdsInterface(first), DdsInterface(vpn)]

    def machine_interfaces(self, vpn: str) -> list[DdsInterface]:
        """Return the interface of a machine's nodes; its address also leads to the machine."""
        return [DdsInterface(vpn)]

    def render(
        self, interfaces: Sequence[DdsInterface], peers: Sequence[str],
        user: Mapping[str, str] = MappingProxyType({}), *, quiet: bool = False,
    ) -> str:
        """
        Return the XML: the user's profiles, with our settings in the default participant.

        :param interfaces: by address; the last one is the VPN's, whose group the nodes use.
        :param peers: VPN addresses of other hosts.
        :param user: the user's environment variables: the profiles of
            FASTRTPS_DEFAULT_PROFILES_FILE are included, and ROS_STATIC_PEERS are asked too.
        :param quiet: announce no group.
        :raises DdsError: the user's profiles cannot be read, or configure transports.
        """
        path = _file(user)
        root, profiles = _profiles(path)
        participant = _default_participant(profiles, path)
        rtps = _child(participant, 'rtps')
        kept = _child(_child(rtps, 'allocation'), 'remote_locators')
        limit = _child(kept, 'max_unicast_locators')
        limit.text = limit.text or str(KEPT_ADDRESSES)
        _child(kept, 'max_multicast_locators').text = '1'
        builtin = _child(rtps, 'builtin')
        discovery = _child(builtin, 'discovery_config')
        for name, seconds in (('leaseDuration', LEASE_DURATION),
                              ('leaseAnnouncement', ANNOUNCEMENT)):
            if discovery.find(name) is None:
                _child(_child(discovery, name), 'sec').text = str(seconds)
        names = [one.name for one in interfaces]
        group = [multicast_group(names[-1])]
        local = local_only(user)
        common = [] if ANY in names and (local or _unicast_only(builtin)) else [DISCOVERY_GROUP]
        # nodes that use a LAN also hear the common group, and so find each other by it. On Linux,
        # a socket hears its groups on each interface on which any process has joined them.
        heard, found_by = (group + common, []) if common and ANY in names else (group, group)
        groups = dict.fromkeys([*common, *found_by, *map(multicast_group, peers)])
        if not quiet:
            # the first group is announced, see max_multicast_locators
            _child(builtin, 'avoid_builtin_multicast').text = 'false'
            _child(builtin, 'metatrafficMulticastLocatorList')[:0] = map(self._group, heard)
        if not (quiet and common):
            # without it, Fast DDS joins the common group
            _child(_child(builtin, 'metatrafficUnicastLocatorList'), 'locator')
        # any initial peer replaces the default one
        _child(builtin, 'initialPeersList').extend([
            *map(self._group, groups),
            *(one for host in [*static_peers(user), *([LOOPBACK] if local else [])]
              for one in self._ports(host))])
        _own_transport(profiles, rtps, names)
        size = ElementTree.SubElement(
            _child(_child(rtps, 'propertiesPolicy'), 'properties'), 'property')
        _text(size, name='fastdds.max_message_size', value=str(DATAGRAM))
        _times(profiles)
        ElementTree.indent(root)
        return ('<?xml version="1.0" encoding="UTF-8"?>\n'
                + ElementTree.tostring(root, encoding='unicode') + '\n')

    def _group(self, address: str) -> Element:
        # the domain's first port is Fast DDS's default; it joins one group for each port
        begin, _ = dds_ports(self.domain)
        return _locator(address, begin if address == DISCOVERY_GROUP else begin + 2)

    def _ports(self, host: str) -> list[Element]:
        if not _PEER.fullmatch(host):
            raise DdsError(f"'{host}' of ROS_STATIC_PEERS is no address or host name",
                           'write addresses or names, separated by ;')
        addresses = addresses_of([host])
        if not addresses:
            # Fast DDS would ignore the whole profile, and nodes would use its defaults
            raise DdsError(
                f"'{host}' of ROS_STATIC_PEERS has no IPv4 address: nodes would not use the VPN",
                'correct the name, or leave it out of ROS_STATIC_PEERS')
        begin, _ = dds_ports(self.domain)
        return [_locator(address, begin + 10 + 2 * index)
                for address in addresses for index in range(ASKED)]

    def environment(self, path: str, user: Mapping[str, str]) -> Mapping[str, str]:
        """
        Return RMW_IMPLEMENTATION and the path of the profile.

        The profile already contains the effect of ROS_AUTOMATIC_DISCOVERY_RANGE. With that
        variable the middleware would add its own transports, which listen on every interface.

        :raises DdsError: the user's environment disables discovery.
        """
        check_discovery(user)
        # in a node's folder, the default file would replace our participant
        variables = {'RMW_IMPLEMENTATION': self.rmw, VARIABLE: path, 'SKIP_DEFAULT_XML_FILE': '1',
                     'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT'}
        if user.get('ROS_LOCALHOST_ONLY') == '1':
            variables['ROS_LOCALHOST_ONLY'] = '0'
        return variables


def _file(user: Mapping[str, str]) -> str:
    """
    Return the path of the user's profiles, '' without any; machines have no user.

    :raises StoreError: the file in the working directory belongs to another account.
    """
    if user.get(VARIABLE) or not user or user.get('SKIP_DEFAULT_XML_FILE') == '1':
        return user.get(VARIABLE, '')
    path = Path(DEFAULT_FILE).absolute()
    return str(check_owner(path)) if path.is_file() else ''


def _profiles(path: str) -> tuple[Element, Element]:
    """Return the root of the user's profiles and the ``profiles`` element; new ones for ''."""
    if not path:
        root = Element('dds', xmlns=NAMESPACE)
        return root, _child(root, 'profiles')
    try:
        root = ElementTree.fromstring(Path(path).read_bytes())
    except OSError as error:
        raise DdsError(f"the profiles {path} of Fast DDS can't be read: {error.strerror}",
                       f'correct or unset {VARIABLE}') from error
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise DdsError(f'{path} is no XML with profiles of Fast DDS: {error}',
                       f'correct it, or unset {VARIABLE}') from error
    for element in root.iter():
        element.tag = re.sub('^{.*}', '', element.tag)
    root.set('xmlns', NAMESPACE)
    if root.tag == 'profiles':
        return root, root
    return root, _child(root, 'profiles')


def _default_participant(profiles: Element, file: str) -> Element:
    for participant in profiles.iter('participant'):
        if participant.get('is_default_profile') == 'true':
            for path, values, effect in _REFUSED:
                for setting in participant.iterfind(f'rtps/{path}'):
                    value = (setting.text or '').strip()
                    if value and value not in values:
                        raise DdsError(
                            f'with {path}={value} of the default participant in {file}, the '
                            f"robot's nodes {effect}: they would not meet those of machines",
                            f'leave {path} out')
            return participant
    return ElementTree.SubElement(
        profiles, 'participant', profile_name='fogros2', is_default_profile='true')


def _unicast_only(builtin: Element) -> bool:
    """Return whether the user's participant announces itself to listed hosts only."""
    return (builtin.find('metatrafficUnicastLocatorList/locator') is not None
            and builtin.find('metatrafficMulticastLocatorList/locator') is None)


def _own_transport(profiles: Element, rtps: Element, names: Sequence[str]) -> None:
    """Let participants use UDP only, on these interfaces; send only to their networks."""
    descriptors = _child(profiles, 'transport_descriptors')
    # transports have to precede the participants that use them
    profiles.remove(descriptors)
    profiles.insert(0, descriptors)
    udp = ElementTree.SubElement(descriptors, 'transport_descriptor')
    _text(udp, transport_id=_UDP, type='UDPv4', receiveBufferSize=rtps.findtext(
        'listenSocketBufferSize') or str(RECEIVE_BUFFER))
    if ANY not in names:
        _text(udp, netmask_filter='ON')
        allowed = _child(udp, 'interfaceWhiteList')
        for name in names:
            ElementTree.SubElement(allowed, 'address').text = name
    _text(_child(rtps, 'userTransports'), transport_id=_UDP)
    _child(rtps, 'useBuiltinTransports').text = 'false'


def _times(profiles: Element) -> None:
    """Set when lost samples are repeated, unless the user's profiles have defaults."""
    if not any(one.tag in ('data_writer', 'publisher') and one.get('is_default_profile') == 'true'
               for one in profiles):
        times = _child(ElementTree.SubElement(
            profiles, 'data_writer', profile_name='fogros2', is_default_profile='true'), 'times')
        for name, milliseconds in (('heartbeatPeriod', HEARTBEAT), ('nackResponseDelay', ANSWER)):
            _text(_child(times, name), nanosec=str(milliseconds * 1_000_000))
    # each process has a writer and all others' readers: a question with each sample, as is the
    # default, would be three quarters of all packets with these names
    names = ElementTree.SubElement(profiles, 'data_writer', profile_name=NODE_NAMES)
    _text(_child(names, 'qos'), disable_heartbeat_piggyback='true')
    _text(_child(_child(names, 'times'), 'heartbeatPeriod'), sec='1')


def _locator(address: str, port: int) -> Element:
    locator = Element('locator')
    _text(_child(locator, 'udpv4'), port=str(port), address=address)
    return locator


def _text(parent: Element, **values: str) -> None:
    for name, value in values.items():
        ElementTree.SubElement(parent, name).text = value


def _child(parent: Element, name: str) -> Element:
    child = parent.find(name)
    return ElementTree.SubElement(parent, name) if child is None else child
