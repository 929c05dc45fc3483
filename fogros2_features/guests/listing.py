# SPDX-License-Identifier: Apache-2.0
"""Ask a machine for its guests, and install the program that keeps them."""

from __future__ import annotations

import ipaddress
import json
from pathlib import Path
from typing import Optional, TypedDict

from fogros2 import untrusted
from fogros2.errors import ConfigurationError, VpnError
from fogros2.model import Command, VpnInterface
from fogros2.shell import Shell
from fogros2.shell.command_line import write_script
from fogros2.store import Record
from fogros2.vpn.wireguard import more
from fogros2_features.guests import network, program
from fogros2_features.guests.invitation import parse_key


class Guest(TypedDict):
    """
    A computer that an invitation admits to a machine.

    :param left: seconds until the invitation expires; negative for one that stays connected.
    :param heard: seconds since the machine noticed its last handshake, None before the first.
    """

    key: str
    label: str
    address: str
    left: float
    heard: Optional[float]


def install(interface: VpnInterface) -> Command:
    """Return the command that puts the program on the machine."""
    return Command(
        ('sh', '-ec', write_script(more(interface), 0o600)), sudo=True,
        input=Path(program.__file__).read_bytes(), what='prepare the VPN for guests')


def request(interface: VpnInterface, verb: str, content: object = None) -> Command:
    """
    Return the command that changes or lists the guests of a machine's interface.

    :param verb: with ``content``, see ``program``.
    """
    path = more(interface)
    return Command(
        ('sh', '-ec', '[ -e "$1" ] || { echo "[]"; exit; }; exec python3 -IS "$@"', 'sh', path,
         interface.name, verb),
        sudo=True, input=json.dumps(content).encode(), what='look at the guests of the VPN')


def ask(shell: Shell, record: Record, verb: str, content: object = None) -> list[Guest]:
    """
    Send a request to the machine's list of guests; return the list.

    :raises FogError: the machine cannot be reached, has no address left, or lies.
    """
    assert record.vpn is not None
    # a busy disk takes a while to delete the wheels in a guest's home
    output = shell.run(request(record.vpn, verb, content),
                       timeout=60.0 if verb == 'remove' else 15.0).stdout
    try:
        return [_checked(guest, record.vpn.network)
                for guest in untrusted.parsed(output, list[Guest])]
    except (ValueError, ConfigurationError) as error:
        raise VpnError(f"'{record.name}' sent an invalid list of guests",
                       'the machine may be hijacked: delete it') from error


def _checked(guest: Guest, subnet: str) -> Guest:
    """Return a guest as a machine describes it, without anything that is not expected."""
    label, key = parse_key(
        f"{guest['label']}:{guest['key']}" if guest['label'] else guest['key'])
    address = ipaddress.IPv4Address(guest['address'])
    if address not in network.guests(subnet):
        raise ValueError
    return Guest(key=key, label=label, address=str(address), left=guest['left'],
                 heard=guest['heard'])
