# SPDX-License-Identifier: Apache-2.0
"""
WireGuard whose interfaces on the robot may be made by a helper of root's, without a password.

An administrator installs the helper and says who may use it (``packaging/vpn_helper``). The
folder of its key shows which way an interface was made, in records of earlier launches too: below
``KEYS`` it is the helper's, elsewhere root's commands make it. Machines' interfaces always are
made by those.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import functools
import json
import os
from pathlib import Path

from fogros2 import process
from fogros2.errors import FogError
from fogros2.model import Command, Peer, VpnInterface
from fogros2.vpn.wireguard import WireGuard

HELPER = '/usr/libexec/fogros2/vpn'
#: Whose members may use it.
GROUP = 'fogros2'
#: What the helper answers to ``check`` if it means by a request what we do.
PROTOCOL = '1'
#: Where it keeps private keys, one folder for each interface; the user can't read them.
KEYS = '/run/fogros2-vpn'


@functools.cache
def permitted() -> bool:
    """Return whether this user, who isn't root, may use the helper without a question."""
    if os.geteuid() == 0 or not Path(HELPER).exists() or process.which('sudo') is None:
        return False
    try:
        said = process.run(_ask('check', {}), timeout=10.0, check=False)
    except FogError:
        return False
    return said.returncode == 0 and said.stdout.strip() == PROTOCOL


def key_file(name: str) -> str:
    """Return where the helper keeps the key of an interface."""
    return f'{KEYS}/{name}/key'


def key_of(name: str) -> str:
    """Return where the key of an interface that the helper has made is, '' if it has none."""
    return key_file(name) if Path(KEYS, name).exists() else ''


def _ask(verb: str, request: Mapping[str, object], what: str = '') -> Command:
    return Command((HELPER, verb), sudo=True, input=json.dumps(request).encode(), what=what)


def _made(interface: VpnInterface) -> bool:
    return interface.key_file == key_file(interface.name)


def _peers(peers: Sequence[Peer]) -> list[dict[str, object]]:
    return [{'key': peer.public_key, 'address': peer.address, 'endpoint': peer.endpoint}
            for peer in peers]


class HelpedWireGuard(WireGuard):
    """As WireGuard; an interface that is the helper's is asked of it."""

    def keys(self, interface: VpnInterface) -> Command:
        """Return the command that makes the name ours, and prints the public key."""
        command = super().keys(interface)
        if not _made(interface):
            return command
        return _ask('keys', {'name': interface.name, 'pid': os.getpid()}, command.what)

    def up(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield what makes the interface."""
        for command in super().up(interface, peers):
            yield command if not _made(interface) else _ask('up', {
                'name': interface.name, 'network': interface.network, 'port': interface.port,
                'domain': self.domain, 'ports': [list(pair) for pair in self.ports[1:]],
                'peers': _peers(peers)}, command.what)

    def peers(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield what makes these the peers."""
        return self._with('peers', interface, super().peers(interface, peers), peers)

    def repair(self, interface: VpnInterface, peers: Sequence[Peer]) -> Iterator[Command]:
        """Yield what gets the interface's program going again."""
        return self._with('repair', interface, super().repair(interface, peers), peers)

    def _with(
        self, verb: str, interface: VpnInterface, commands: Iterator[Command],
        peers: Sequence[Peer],
    ) -> Iterator[Command]:
        for command in commands:
            yield command if not _made(interface) else _ask(
                verb, {'name': interface.name, 'peers': _peers(peers)}, command.what)

    def status(self, interface: VpnInterface) -> Command:
        """Return the command that asks for counters."""
        command = super().status(interface)
        if not _made(interface):
            return command
        return _ask('status', {'name': interface.name}, command.what)

    def down(self, interface: VpnInterface) -> Iterator[Command]:
        """Yield what takes the interface away, with its key."""
        for command in super().down(interface):
            yield command if not _made(interface) else _ask(
                'down', {'name': interface.name}, command.what)
