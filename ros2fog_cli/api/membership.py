# SPDX-License-Identifier: Apache-2.0
"""Join the VPN of another robot's machine by an invitation, and leave it."""

from __future__ import annotations

import base64
from collections.abc import Mapping
import hashlib
import json
import os
from pathlib import Path
from typing import Optional

from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from fogros2 import plugin_system, process
from fogros2.dds import addresses_of, DdsVendor
from fogros2.deploy.robot import check_robot, run
from fogros2.errors import ConfigurationError, DdsError, VpnError
from fogros2.invitation import Invitation, own_key, unseal
from fogros2.model import Peer, to_json, VpnInterface
from fogros2.store import boot_id, process_start, Store, write_private
from fogros2.vpn import addresses, helped, Vpn
from fogros2.waiting import Timeouts
from ros2fog_cli.api import endings, guests, reach


def join(text: str, store: Store, environment: Mapping[str, str] = os.environ) -> Path:
    """
    Bring up this computer's end of a machine's VPN; return the folder for its terminals.

    Idempotent. The folder is like the one of a launch. It names the first process of this
    computer: ``ros2 fog gc`` clears the folder after a reboot, which also ends the interface.

    :raises FogError: the invitation is not for this computer, has expired, or collides with a
        network here; or the interface cannot be created.
    """
    key = own_key(store)
    invitation = unseal(text, key)
    vendor = _vendor(invitation, environment)
    number = hashlib.sha256(f'{invitation.key} {invitation.joiner}'.encode()).hexdigest()[:6]
    folder = store.root / 'launches' / number
    name = f'fog{number}'
    up = Path('/sys/class/net', name).exists()
    if up and _known(folder) == invitation:
        return folder
    check_robot()
    before = reach.joined(store).get(invitation.machine, folder)
    if before != folder:
        endings.clear(before)  # of a launch with this machine that has ended
    if not up:
        _check_free(invitation)
    interface = VpnInterface(
        name, invitation.joiner, invitation.network, addresses.choose_port(environment),
        helped.key_file(name) if helped.permitted() else str(folder / 'vpn.key'), firewall=True)
    vpn: Vpn = plugin_system.load('fogros2.vpn', 'wireguard')(
        domain=invitation.domain, ports=vendor.ports,
        asked=addresses_of(vendor.asked(environment)))
    private = base64.b64encode(key.private_bytes(
        Encoding.Raw, PrivateFormat.Raw, NoEncryption())).decode()
    store.launch(number)
    try:
        _write(folder, invitation, interface, vendor, environment)
        if helped.made(interface):
            process.run(helped.lend(interface, private), timeout=Timeouts().vpn)
        else:
            write_private(Path(interface.key_file), f'{private}\n'.encode())
        run(vpn.up(interface, [Peer(invitation.machine, invitation.key, invitation.address,
                                    invitation.endpoint)]), timeout=Timeouts().vpn)
    except BaseException:
        endings.clear(folder)
        raise
    return folder


def _vendor(invitation: Invitation, environment: Mapping[str, str]) -> DdsVendor:
    guests.check_rmw(invitation.rmw)
    if invitation.rmw not in plugin_system.names('fogros2.dds'):
        raise DdsError(f'FogROS2 does not support RMW_IMPLEMENTATION={invitation.rmw}')
    vendor: DdsVendor = plugin_system.load('fogros2.dds', invitation.rmw)(
        domain=invitation.domain)
    return vendor


def _check_free(invitation: Invitation) -> None:
    """
    Check that no network of this computer has addresses of the VPN.

    :raises VpnError: one has.
    """
    used = addresses.parse_used(run([addresses.used_networks()], timeout=Timeouts().vpn))
    if found := addresses.overlapping(invitation.network, used):
        raise VpnError(
            f"the VPN of '{invitation.machine}' has the addresses {invitation.network}, and this "
            f'computer uses {found[0]}',
            f'{addresses.POOL_VARIABLE} on the inviting robot names another range: launch again')


def _write(
    folder: Path, invitation: Invitation, interface: VpnInterface, vendor: DdsVendor,
    environment: Mapping[str, str],
) -> None:
    """Write the files of a launch's folder that terminals read, and the invitation."""
    lan = vendor.parse_lan(run([vendor.ask_lan()], timeout=Timeouts().vpn))
    interfaces = vendor.robot_interfaces(
        interface.address if vendor.by_address else interface.name, lan, environment)
    for name, content in {
            vendor.file_name: vendor.render(interfaces, (), environment),
            'domain': str(invitation.domain), 'rmw': vendor.rmw,
            'process.json': json.dumps(
                {'pid': 1, 'pid_start': process_start(1) or 0, 'boot': boot_id()}),
            reach.JOINED: to_json(invitation)}.items():
        write_private(folder / name, content.encode())


def _known(folder: Path) -> Optional[Invitation]:
    """Return the invitation by which this computer has joined, None if there is none."""
    try:
        return Invitation(**json.loads((folder / reach.JOINED).read_text()))
    except (OSError, ValueError, TypeError):
        return None


def leave(name: str, store: Store) -> None:
    """
    Delete this computer's end of a machine's VPN; nodes that use it have to end before.

    :raises ConfigurationError: this computer has not joined the machine.
    """
    folder = reach.joined(store).get(name)
    if folder is None:
        raise ConfigurationError(f"this computer has not joined a machine '{name}'",
                                 'ros2 fog join INVITATION joins one')
    endings.clear(folder)


def link(folder: Path) -> reach.Link:
    """
    Measure the link of this computer to a machine that it has joined.

    :raises FogError: the status of the interface cannot be read.
    """
    name = f'fog{folder.name}'
    joined = json.loads((folder / reach.JOINED).read_text())
    interface = VpnInterface(name, joined['joiner'], joined['network'], 0,
                             helped.key_of(name) or str(folder / 'vpn.key'), firewall=True)
    return reach.measure(joined['address'], interface, joined['key'], 'wireguard')
