# SPDX-License-Identifier: Apache-2.0
"""Admit other computers to a machine of this robot: invite, revoke."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import secrets
import time
from typing import Optional

from fogros2 import plugin_system
from fogros2.errors import CommandError, ConfigurationError, VpnError
from fogros2.model import host_port
from fogros2.shell import multiplexer
from fogros2.store import Record, Store
from fogros2.vpn import addresses, Vpn
from fogros2_features.guests import invitation, listing, membership, network
from ros2fog_cli.api import machines, reach
from ros2fog_cli.api.machines import Entry

#: Seconds without a handshake after which a guest whose invitation has expired is removed: a
#: connected WireGuard peer makes a handshake at least each 2 minutes.
PATIENCE = 180.0


def invite(
    name: str, key: str, seconds: float, warn: Callable[[str], None], *,
    host: Optional[str] = None, store: Optional[Store] = None,
) -> str:
    """
    Admit a computer to a machine's VPN; return the invitation for it.

    :param key: the text of ``ros2 fog key`` of that computer.
    :param seconds: how long it may join.
    :param host: address at which it dials the machine; None for the provider's choice.
    :raises FogError: no launch uses the machine, or no other computer can dial the machine.
    """
    store = store or Store()
    label, public = invitation.parse_key(key)
    entry = reach.find(name, warn)
    record = held(entry)
    assert entry.machine is not None and record.vpn is not None and record.robot_vpn is not None
    folder = store.root / 'launches' / record.launch
    rmw, domain = (folder / 'rmw').read_text(), int((folder / 'domain').read_text())
    membership.check_rmw(rmw)
    server, port = machines.load(entry.provider).dialled_at(entry.machine, record.vpn.port, host)
    server = server or addresses.own_address()
    secret = secrets.token_hex(32)
    dds = plugin_system.load('fogros2.dds', rmw)(domain=domain)
    with reach.session(entry) as shell:
        shell.run(listing.install(record.vpn), timeout=15.0)
        guests = listing.ask(shell, record, 'admit', {
            'key': public, 'label': label, 'seconds': seconds, 'secret': secret,
            'left': (record.armed or time.time()) + record.spec.lifetime - time.time(),
            'rules': network.rules(record.vpn, dds.ports),
            'door': door(record),
            'patience': max(PATIENCE, record.spec.robot_timeout),
            'addresses': [str(address) for address in network.guests(record.vpn.network)
                          if int(address) & 255 != 255]})
    address = next((guest['address'] for guest in guests if guest['key'] == public), None)
    if address is None:
        raise VpnError(f"'{name}' admits nobody: by this robot's clock, its lifetime is over",
                       f'ros2 fog status {name} shows the time that it has left')
    return invitation.seal(invitation.Invitation(
        machine=name, key=record.public_key, address=record.vpn.address,
        endpoint=host_port(server, port), joiner=address, network=record.vpn.network,
        rmw=rmw, domain=domain, expires=time.time() + seconds,
        interface=record.vpn.name, secret=secret), public)


def door(record: Record) -> dict[str, object]:
    """Return what starts the door of a machine's guests; see ``program``."""
    assert record.vpn is not None
    vpn: Vpn = plugin_system.load('fogros2.vpn', 'wireguard')()
    return {
        'shell': Path(multiplexer.__file__).read_text(), 'machine': record.name,
        'address': record.vpn.address, 'port': network.PORT,
        'agent': record.agent_program, 'process': record.vpn.process,
        'down': '\n'.join(command.argv[-1] for command in vpn.down(record.vpn))}


def held(entry: Entry, *, kept: bool = False) -> Record:
    """
    Return the record of a machine that a launch of this robot uses.

    :param kept: the launch may have ended and kept the machine.
    :raises ConfigurationError: no launch does, so the machine has no VPN.
    """
    record = entry.record
    if record is None or entry.machine is None or record.vpn is None or not (
            kept or record.launch_alive and record.launch) or not record.public_key:
        raise ConfigurationError(
            f"no launch on this robot runs with the machine '{entry.name}', so it has no VPN",
            'invite while the launch that created it runs')
    return record


def revoke(name: str, who: Optional[str], warn: Callable[[str], None]) -> list[str]:
    """
    Remove guests from a machine; return their names or keys.

    :param who: a guest's name, VPN address or key; None for all guests.
    :raises FogError: there is no such guest, or the machine cannot be reached.
    """
    entry = reach.find(name, warn)
    record = held(entry, kept=True)
    with reach.session(entry) as shell:
        try:
            guests = listing.ask(shell, record, 'look')
        except CommandError as error:
            if 'Unable to access interface' not in error.result.stderr:
                raise
            guests = []  # the VPN ended with its launch
        key = invitation.parse_key(who)[1] if who and who.endswith('=') else who
        matches = [guest for guest in guests
                   if who is None or key in (guest['label'], guest['address'], guest['key'])]
        if who is not None and not matches:
            raise ConfigurationError(f"'{name}' has no guest {who}",
                                     f'ros2 fog status {name} shows its guests')
        if matches:
            listing.ask(shell, record, 'remove', {'keys': [guest['key'] for guest in matches]})
    return [guest['label'] or guest['key'] for guest in matches]
