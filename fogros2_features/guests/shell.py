# SPDX-License-Identifier: Apache-2.0
"""
Run commands in a guest's account of another robot's machine, inside the VPN.

WireGuard encrypts the connection, and shows the machine whose address this is. The door there
(``program``) sends a challenge. This end answers with an HMAC, by the secret of the
invitation, so that another account of this computer is not the guest.
"""

from __future__ import annotations

import contextlib
import hmac
from pathlib import Path
import socket
import threading
from typing import Optional

from fogros2.errors import AuthenticationError, ConnectError
from fogros2.model import Endpoint
from fogros2.shell.multiplexed import Link
from fogros2.shell.remote import MultiplexedShell

#: Bytes of the challenge, and of the longest answer to its proof.
_CHALLENGE, _LINE = 32, 300
#: Time-out of a partly transferred frame, in seconds: its thread holds the lock.
_STALL = 10.0


class GuestShell(MultiplexedShell):
    """
    A Shell for endpoints of kind 'guest'; ``key_file`` has the invitation's secret.

    :param name: the machine's name, for messages.
    :param timeout: seconds for which to try to connect.
    """

    def _connect(self, timeout: float, cancel: Optional[threading.Event]) -> Link:
        return Link(admitted(self.endpoint, self.name, timeout), self.name, self.user)


def admitted(endpoint: Endpoint, name: str, timeout: float) -> socket.socket:
    """
    Return a connection to the shell behind a machine's door.

    :raises ConnectError: the machine does not answer, or has no account for a guest.
    :raises AuthenticationError: the machine does not know the invitation, or this computer has
        left it.
    """
    text = b''
    try:
        secret = bytes.fromhex(Path(endpoint.key_file or '').read_text())
    except (OSError, ValueError) as error:
        raise AuthenticationError(f"this computer has left '{name}': {error}",
                                  'join it again: ros2 fog join') from error
    with contextlib.ExitStack() as failed:
        try:
            link = failed.enter_context(
                socket.create_connection((endpoint.host, endpoint.port), timeout))
            try:
                link.sendall(hmac.digest(
                    secret, link.recv(_CHALLENGE, socket.MSG_WAITALL), 'sha256'))
                while not text.endswith(b'\n') and len(text) < _LINE:
                    text += (more := link.recv(1))
                    if not more:
                        raise ConnectionResetError('it closed the connection')
            except ConnectionError as error:
                raise AuthenticationError(f"'{name}' refuses this invitation: {error}",
                                          'ask for a new one: ros2 fog invite') from error
        except OSError as error:
            raise ConnectError(
                f"'{name}' does not answer: {error}",
                'the invitation may have been revoked, or the machine may have ended') from error
        if text != b'\n':
            raise ConnectError(f"'{name}' has no room for this computer: "
                               f'{text.decode(errors="replace").strip()}',
                               'the machine needs useradd, of the package passwd')
        link.settimeout(_STALL)
        failed.pop_all()
    return link
