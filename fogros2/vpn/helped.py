# SPDX-License-Identifier: Apache-2.0
"""
WireGuard whose interfaces on the robot a root helper can create, without a password.

An administrator installs the helper and chooses its users (``packaging/vpn_helper``). The folder
of an interface's key shows how the interface was created, also in records of earlier launches: the
helper's keys are below ``KEYS``, and root's commands create all other interfaces. Root's commands
always create the interfaces of machines.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import functools
import json
import os
from pathlib import Path

from fogros2 import process
from fogros2.errors import FogError
from fogros2.model import Command, Peer, VpnInterface
from fogros2.vpn.wireguard import WireGuard

HELPER = '/usr/libexec/fogros2/vpn'
#: The group whose members may use the helper.
GROUP = 'fogros2'
#: The helper's answer to ``check`` if its protocol is the one of this module.
PROTOCOL = '5'
#: Folder of the helper's private keys, one subfolder per interface; the user cannot read them.
KEYS = '/run/fogros2-vpn'


@functools.cache
def permitted() -> bool:
    """Return whether this user is not root and may use the helper without a password."""
    if os.geteuid() == 0 or not Path(HELPER).exists() or process.which('sudo') is None:
        return False
    try:
        reply = process.run(_ask('check', {}), timeout=10.0, check=False)
    except FogError:
        return False
    return reply.returncode == 0 and reply.stdout.strip() == PROTOCOL


def key_file(name: str) -> str:
    """Return the path of the helper's key for an interface."""
    return f'{KEYS}/{name}/key'


def key_of(name: str) -> str:
    """Return the path of the key of an interface that the helper has created, '' otherwise."""
    return key_file(name) if Path(KEYS, name).exists() else ''


def _ask(verb: str, request: Mapping[str, object], what: str = '') -> Command:
    return Command((HELPER, verb), sudo=True, input=json.dumps(request).encode(), what=what)


def lend(interface: VpnInterface, private: str) -> Command:
    """Return the command that gives the helper the key of an interface that no launch has."""
    return _ask('keys', {'name': interface.name, 'pid': 0, 'private': private})


def made(interface: VpnInterface) -> bool:
    """Return whether the helper creates, or has created, an interface."""
    return interface.key_file == key_file(interface.name)


def _peers(peers: Sequence[Peer]) -> list[dict[str, object]]:
    return [{'key': peer.public_key, 'address': peer.address, 'endpoint': peer.endpoint}
            for peer in peers]


class HelpedWireGuard(WireGuard):
    """WireGuard that uses the helper for an interface with a key below ``KEYS``."""

    def keys(self, interface: VpnInterface) -> Command:
        """Return the command that reserves the interface's name, and prints the public key."""
        return next(self._ask(
            'keys', interface, [super().keys(interface)], pid=os.getpid(), private=''))

    def up(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield the commands that create the interface."""
        return self._ask(
            'up', interface, super().up(interface, peers), peers=_peers(peers),
            network=interface.network, address=interface.address, port=interface.port,
            ports=[list(pair) for pair in self.ports], asked=list(self.asked))

    def peers(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield the commands that set the peers."""
        return self._ask('peers', interface, super().peers(interface, peers), peers=_peers(peers))

    def repair(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield the commands that restart the interface's program."""
        return self._ask(
            'repair', interface, super().repair(interface, peers), peers=_peers(peers))

    def status(self, interface: VpnInterface) -> Command:
        """Return the command that prints the counters."""
        return next(self._ask('status', interface, [super().status(interface)]))

    def down(self, interface: VpnInterface) -> Iterator[Command]:
        """Yield the commands that delete the interface and its key."""
        return self._ask('down', interface, super().down(interface))

    def _ask(
        self, verb: str, interface: VpnInterface, commands: Iterable[Command], **request: object,
    ) -> Iterator[Command]:
        """Yield requests to the helper instead of commands, if the helper has the interface."""
        for command in commands:
            yield command if not made(interface) else _ask(
                verb, {'name': interface.name, **request}, command.what)
