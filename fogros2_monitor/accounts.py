# SPDX-License-Identifier: Apache-2.0
"""Recognise clients that other accounts of this computer run."""

from __future__ import annotations

from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import ipaddress
import os
import socket
import struct
import threading
from typing import Any, Optional

#: Header of a netlink message: length, type, flags, sequence number, port.
_HEAD = struct.Struct('=IHHII')
#: NETLINK_SOCK_DIAG, SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST, all states, INET_DIAG_NOCOOKIE.
_SOCK_DIAG, _BY_FAMILY, _REQUEST, _ANY_STATE, _NO_COOKIE = 4, 20, 1, 0xffffffff, (1 << 64) - 1
#: Offset of the account in the kernel's answer; the inode follows.
_USER = 64


class OwnServer(ThreadingHTTPServer):
    """
    An HTTP server on the loopback interface for this account and root alone, in a thread.

    :param port: 0: any free port.
    :raises OSError: the port is in use.
    """

    # threads, because browsers open connections in advance that send no request
    daemon_threads = True

    def __init__(self, port: int, handler: type[BaseHTTPRequestHandler]) -> None:
        super().__init__(('127.0.0.1', port), handler)
        # close() waits for the end of a poll, in seconds
        self._thread = threading.Thread(
            target=self.serve_forever, args=(0.05,), name='fog-http', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the server."""
        self.shutdown()
        self._thread.join()
        self.server_close()

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
    user = _account(peer, own)
    return _is_here(peer) if user is None else user not in (0, os.getuid())


def is_strangers(connection: socket.socket) -> bool:
    """
    Return whether another account of this computer, root aside, serves a TCP connection.

    It could listen before the program that is expected there. An engine that redirects a port by
    the packet filter has no socket.

    :raises OSError: the server has gone.
    """
    peer, own = connection.getpeername(), connection.getsockname()
    # in this order: a listener that has gone has accepted the connection before
    users = [_account(peer, end) for end in ((own[0], 0), own)]
    return any(user not in (None, 0, os.getuid()) for user in users)


def plain_address(address: str) -> str:
    """Return a peer's address; map an IPv4 address of a dual-stack socket back to IPv4."""
    peer = ipaddress.ip_address(address.partition('%')[0])
    mapped = getattr(peer, 'ipv4_mapped', None)
    return str(mapped or peer)


def _account(peer: tuple[Any, ...], own: tuple[Any, ...]) -> Optional[int]:
    """
    Return the uid of the socket at the other end of a connection, None if no program has it.

    The kernel looks up one socket of either family (linux/inet_diag.h). To read all of them from
    /proc would take 0.3 s once another account has opened 9,000.
    """
    ends = [ipaddress.ip_address(plain_address(name[0])).packed for name in (peer, own)]
    family = socket.AF_INET if len(ends[0]) == 4 else socket.AF_INET6
    request = struct.pack('=4BI', family, socket.IPPROTO_TCP, 0, 0, _ANY_STATE) + struct.pack(
        '!HH16s16s', peer[1], own[1], *ends) + struct.pack('=IQ', 0, _NO_COOKIE)
    head = _HEAD.pack(_HEAD.size + len(request), _BY_FAMILY, _REQUEST, 0, 0)
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, _SOCK_DIAG) as kernel:
            kernel.send(head + request)
            answer = kernel.recv(4096)
    except OSError:
        return None  # a kernel without this protocol
    if _HEAD.unpack_from(answer)[1] != _BY_FAMILY:
        return None  # an error: there is no such socket
    user, inode = struct.unpack_from('=II', answer, _HEAD.size + _USER)
    # a socket that its program has closed has no inode
    return int(user) if inode else None


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
