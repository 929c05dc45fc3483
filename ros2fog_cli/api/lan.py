# SPDX-License-Identifier: Apache-2.0
"""
Find DDS participants on the networks of this computer, without joining DDS.

The functions announce a participant without endpoints by the RTPS specification's SPDP
(OMG RTPS 2.5, 8.5.3 and 9.6.2). Each participant answers at once with its own announcement, to
the address in ours. Our announcement expires by its lease of two seconds.
"""

from __future__ import annotations

import re
import secrets
import socket
import struct
import time

from fogros2 import process
from fogros2.model import Command

GROUP = '239.255.0.1'
HERE = 'this computer'
PORT_BASE, PORTS_PER_DOMAIN = 7400, 250
#: ROS domain id whose ports are the last ones.
HIGHEST_DOMAIN = 232
#: Vendor id of the specification for an unknown vendor.
_VENDOR = b'\x00\x00'
_PARTICIPANT = b'\x00\x00\x01\xc1'
_SPDP_WRITER, _SPDP_READER = b'\x00\x01\x00\xc2', b'\x00\x01\x00\xc7'


def participants(domain: int, seconds: float) -> dict[str, int]:
    """
    Return the number of DDS participants of a domain at each address, of this computer at HERE.

    :param domain: ROS domain id.
    :param seconds: how long to wait for answers.
    :raises OSError: no socket can be opened.
    """
    own = addresses()
    prefixes_of: dict[str, set[bytes]] = {}
    prefix = _VENDOR + secrets.token_bytes(10)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(('', 0))
        port = link.getsockname()[1]
        end = time.monotonic() + seconds
        again = 0.0
        while (now := time.monotonic()) < end:
            if now >= again:
                again = now + 0.5
                for address in own:
                    _announce(link, address, port, prefix, domain)
            link.settimeout(max(0.01, min(again, end) - now))
            try:
                data, (host, _) = link.recvfrom(65536)
            except TimeoutError:
                continue
            # The header is RTPS, version, vendor, then the sender's GUID prefix.
            if data[:4] == b'RTPS' and len(data) >= 20:
                prefixes_of.setdefault(HERE if host in own else host, set()).add(data[8:20])
    return {host: len(prefixes) for host, prefixes in prefixes_of.items()}


def addresses() -> list[str]:
    """Return this computer's IPv4 addresses on networks with possible other computers."""
    output = process.run(Command(('ip', '-4', '-o', 'addr', 'show', 'up')), timeout=5.0,
                         check=False).stdout
    ipv4 = []
    for line in output.splitlines():
        match = re.search(r'^\d+: (\S+)\s+inet ([0-9.]+)', line)
        # Point-to-point links and our own VPNs carry no multicast.
        if match and match[1] != 'lo' and not re.match(r'fog[0-9a-f]{6}|wg|tun', match[1]):
            ipv4.append(match[2])
    return ipv4


def _announce(
    link: socket.socket, address: str, port: int, prefix: bytes, domain: int,
) -> None:
    link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
    link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
    try:
        link.sendto(announcement(prefix, address, port, domain),
                    (GROUP, PORT_BASE + PORTS_PER_DOMAIN * domain))
    except OSError:
        pass  # an interface without multicast finds no participants


def announcement(prefix: bytes, address: str, port: int, domain: int) -> bytes:
    """
    Return the RTPS message that announces a participant without endpoints.

    :param prefix: 12 bytes of its GUID.
    :param address: where participants should send their answers, with ``port``.
    """
    locator = struct.pack('<iI', 1, port) + bytes(12) + socket.inet_aton(address)
    parameters = [
        (0x0015, b'\x02\x03\x00\x00'),                       # protocol version 2.3
        (0x0016, _VENDOR + b'\x00\x00'),                     # vendor
        (0x0050, prefix + _PARTICIPANT),                     # participant's GUID
        (0x000f, struct.pack('<I', domain)),                 # domain id
        (0x0032, locator), (0x0031, locator),                # metatraffic and default unicast
        (0x0002, struct.pack('<iI', 2, 0)),                  # lease: 2 s
        (0x0058, struct.pack('<I', 0x3)),                    # builtin endpoints: SPDP alone
    ]
    payload = b'\x00\x03\x00\x00' + b''.join(             # parameter list, little endian
        struct.pack('<HH', kind, len(value)) + value for kind, value in parameters)
    payload += struct.pack('<HH', 1, 0)                     # sentinel
    data = struct.pack('<HH', 0, 16) + _SPDP_READER + _SPDP_WRITER + struct.pack('<iI', 0, 1)
    body = data + payload
    # DATA: little endian, with a payload
    return b'RTPS\x02\x03' + _VENDOR + prefix + struct.pack('<BBH', 0x15, 0x05, len(body)) + body
