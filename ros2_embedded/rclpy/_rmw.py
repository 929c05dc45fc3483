# SPDX-License-Identifier: Apache-2.0
"""What rmw_cyclonedds makes of ROS 2's environment variables."""

import os
import re

from rclpy.exceptions import RCLError

_RANGES = ('SUBNET', 'LOCALHOST', 'OFF', 'SYSTEM_DEFAULT')
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
    if given == 'LOCALHOST' and not peers and not _names_interfaces(uri):
        # ROS 2's Cyclone DDS says hello over the loopback, whatever interface it has chosen; this
        # one hears nothing from an interface that it wasn't told of
        general += '<Interfaces><NetworkInterface name="lo"/></Interfaces>'
    if given == 'OFF':
        discovery = ('<ParticipantIndex>none</ParticipantIndex>'
                     f'<Tag>ros_discovery_off_{os.getpid()}</Tag>')
    else:
        discovery = ('<ParticipantIndex>auto</ParticipantIndex>'
                     '<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>')
    if given == 'LOCALHOST':
        peers.insert(0, 'localhost')
    if peers:
        listed = ''.join(f'<Peer address="{peer}"/>' for peer in peers)
        discovery += f'<Peers>{listed}</Peers>'
    return (f'<CycloneDDS><Domain><General>{general}</General><Discovery>{discovery}</Discovery>'
            f'{_BUFFER}</Domain></CycloneDDS>,{uri}')
