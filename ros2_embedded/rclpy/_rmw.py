# SPDX-License-Identifier: Apache-2.0
"""What rmw_cyclonedds makes of ROS 2's environment variables."""

import fcntl
import os
import re
import socket
import struct

from rclpy.exceptions import RCLError

_RANGES = ('SUBNET', 'LOCALHOST', 'OFF', 'SYSTEM_DEFAULT')
# requests and flags of Linux's netdevice(7)
_GET_FLAGS, _GET_ADDRESS = 0x8913, 0x8915
_UP, _LOOPBACK = 0x1, 0x8
_IMPLEMENTATION = 'rmw_cyclonedds_cpp'
# an image of 6 MB arrives faster than it is read; what the kernel doesn't give is no error
_BUFFER = '<Internal><SocketReceiveBufferSize max="10MB"/></Internal>'


def domain_id(given: int | None) -> int:
    """
    Give the domain: the given one, ROS_DOMAIN_ID's, or 0.

    :raises RCLError: if it isn't a number from 0 to 232.
    """
    if given is None:
        text = os.environ.get('ROS_DOMAIN_ID', '')
        if not text:
            return 0
        if not text.isdigit():
            raise RCLError(f'failed to get domain id: ROS_DOMAIN_ID is not an integral number: '
                           f"'{text}'")
        given = int(text)
    if given > 232:
        raise RCLError(f'failed to create a domain: domain id {given} is out of range, '
                       'it has to be between 0 and 232')
    return given


def check_implementation() -> None:
    """
    Refuse another middleware than Cyclone DDS.

    :raises RCLError: if RMW_IMPLEMENTATION asks for one.
    """
    wanted = os.environ.get('RMW_IMPLEMENTATION', '')
    if wanted not in ('', _IMPLEMENTATION):
        raise RCLError(
            f"RMW_IMPLEMENTATION is '{wanted}', and the embedded default has {_IMPLEMENTATION} "
            'alone: unset it, or use ROS 2')


def _names_interfaces(uri: str) -> bool:
    """Say whether a user's configuration, its files included, chooses network interfaces."""
    for name in re.findall(r'file://([^,]+)', uri):
        if os.path.isfile(name):
            with open(name, encoding='utf-8', errors='replace') as file:
                uri += file.read()
    return 'NetworkInterface' in uri


def _leads_away() -> bool:
    """Say whether Cyclone DDS would choose another interface than the loopback by itself."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, name in socket.if_nameindex():
            request = name.encode().ljust(64, b'\0')  # more than a struct ifreq
            try:
                flags, = struct.unpack_from('H', fcntl.ioctl(asked, _GET_FLAGS, request), 16)
                fcntl.ioctl(asked, _GET_ADDRESS, request)
            except OSError:
                continue  # it has no address, or is gone
            if flags & _UP and not flags & _LOOPBACK:
                return True
    return False


def configuration(domain: int) -> str:
    """
    Give Cyclone DDS's configuration: ROS 2's own fragment, then the user's CYCLONEDDS_URI.

    :raises RCLError: if ROS_AUTOMATIC_DISCOVERY_RANGE is none of ROS 2's.
    """
    given = os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper()
    if not given:
        localhost = os.environ.get('ROS_LOCALHOST_ONLY', '0') == '1'
        given = 'LOCALHOST' if localhost else 'SUBNET'
    if given not in _RANGES:
        raise RCLError(f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{given}', not one of "
                       f"{', '.join(_RANGES)}")
    uri = os.environ.get('CYCLONEDDS_URI', '')
    if given == 'SYSTEM_DEFAULT':
        return uri
    peers = [] if given == 'OFF' else [
        peer for peer in os.environ.get('ROS_STATIC_PEERS', '').split(';') if peer]
    general, discovery = '', ''
    if given in ('LOCALHOST', 'OFF'):
        general = '<AllowMulticast>false</AllowMulticast>'
    if given == 'LOCALHOST' and not _names_interfaces(uri):
        # ROS 2's Cyclone DDS says hello over the loopback, and hears those who have this computer
        # among their peers, whatever interface it has chosen; this one hears nothing from an
        # interface that its configuration lacks. It asks peers from the first one alone,
        # which leads nowhere from a loopback
        chosen = '<NetworkInterface autodetermine="true"/>' if _leads_away() else ''
        last = ' priority="-1"' if peers else ''
        general += f'<Interfaces><NetworkInterface name="lo"{last}/>{chosen}</Interfaces>'
    if given == 'OFF':
        discovery = ('<ParticipantIndex>none</ParticipantIndex>'
                     f'<Tag>ros_discovery_off_{os.getpid()}</Tag>')
    else:
        discovery = ('<ParticipantIndex>auto</ParticipantIndex>'
                     '<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>')
    if given == 'LOCALHOST':
        peers.insert(0, 'localhost')
    if peers:
        # ROS 2's Cyclone DDS asks them every 8 s, as long as it runs; this one but once by itself
        listed = ''.join(f'<Peer address="{peer}" PruneDelay="inf"/>' for peer in peers)
        discovery += f'<Peers>{listed}</Peers><SPDPInterval>8 s</SPDPInterval>'
    return (f'<CycloneDDS><Domain><General>{general}</General><Discovery>{discovery}</Discovery>'
            f'{_BUFFER}</Domain></CycloneDDS>,{uri}')
