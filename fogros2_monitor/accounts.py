# SPDX-License-Identifier: Apache-2.0
"""Recognise clients that other accounts of this computer run."""

from __future__ import annotations

import contextlib
from http.server import ThreadingHTTPServer
import ipaddress
import os
from pathlib import Path
import socket
import sys
from typing import Any


class OwnServer(ThreadingHTTPServer):
    """An HTTP server on the loopback interface for this account and root alone."""

    daemon_threads = True

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Refuse other accounts of this computer: each connection takes a thread."""
        return not is_foreign(request)


def is_foreign(connection: socket.socket) -> bool:
    """
    Return whether another account of this computer, root aside, opened a TCP connection.

    Such a client could use up the connections of a server that checks a token only later. A
    client of this computer without a known account is foreign too, such as one that has closed
    its socket.
    """
    try:
        peer, own = connection.getpeername(), connection.getsockname()
    except OSError:
        return True  # the client has gone
    ends = [_listed(*name[:2]) for name in (peer, own)]
    for table in ('tcp', 'tcp6'):
        with contextlib.suppress(OSError):  # a kernel without IPv6
            for line in Path('/proc/net', table).read_text().splitlines()[1:]:
                fields = line.split()
                user, inode = fields[7], fields[9]
                # a socket that its program has closed is listed as root's, without an inode
                if [end.removeprefix(_MAPPED) for end in fields[1:3]] == ends and inode != '0':
                    return int(user) not in (0, os.getuid())
    return _is_here(peer)


def plain_address(address: str) -> str:
    """Return a peer's address; map an IPv4 address of a dual-stack socket back to IPv4."""
    found = ipaddress.ip_address(address.partition('%')[0])
    mapped = getattr(found, 'ipv4_mapped', None)
    return str(mapped or found)


def _listed(address: str, port: int) -> str:
    """Return an address and a port as the kernel lists them."""
    return _words(ipaddress.ip_address(plain_address(address)).packed) + f':{port:04X}'


def _words(packed: bytes) -> str:
    return ''.join(f'{int.from_bytes(packed[at:at + 4], sys.byteorder):08X}'
                   for at in range(0, len(packed), 4))


#: What the kernel lists before an IPv4 address that an IPv6 socket uses.
_MAPPED = _words(ipaddress.ip_address('::ffff:0.0.0.0').packed[:12])


def _is_here(peer: tuple[Any, ...]) -> bool:
    """Return whether an address is one of this computer: no other can be bound."""
    address = plain_address(peer[0])
    six = ':' in address
    family = socket.AF_INET6 if six else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, 0, *peer[2:]) if six else (address, 0))
        except OSError:
            return False
    return True
