# SPDX-License-Identifier: Apache-2.0
"""Join the VPN of another robot's machine by an invitation, and leave it."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Mapping
import contextlib
import dataclasses
import fcntl
import functools
import os
from pathlib import Path
from typing import Optional

from fogros2 import plugin_system, process
from fogros2.dds import addresses_of, DdsVendor
from fogros2.deploy.robot import check_robot, clear, run
from fogros2.errors import ConfigurationError, DdsError, did_you_mean, VpnError
from fogros2.model import OtherVpn, Peer, to_json, VpnInterface
from fogros2.store import (
    boot_id,
    launch_process,
    make_folder,
    OTHER_VPN,
    process_start,
    Store,
    write_private,
)
from fogros2.store import other_vpn as stored_vpn
from fogros2.vpn import addresses, helped, Vpn
from fogros2.waiting import Timeouts
from fogros2_features.guests import network
from fogros2_features.guests.invitation import DOOR_KEY, Invitation, own_key, unseal


def join(
    text: str, store: Store, environment: Mapping[str, str] = os.environ, *,
    owner: Optional[Mapping[str, object]] = None,
    agreed: Callable[[str], bool] = lambda question: False,
) -> Path:
    """
    Bring up this computer's end of a machine's VPN; return the folder for its terminals.

    Idempotent. The folder is like the one of a launch. It names the process that has joined, or
    else the first one of this computer: ``ros2 fog gc`` clears the folder after a reboot, which
    also ends the interface.

    :param owner: the fields of a record that name a process.
    :param agreed: asks the user whether to route public addresses into the VPN.
    :raises FogError: the invitation is not for this computer, has expired, or collides with a
        network here; the user does not agree; or the interface cannot be created.
    """
    key = own_key(store)
    invitation = unseal(text, key)
    vendor = _vendor(invitation, environment)
    folder = store.root / 'launches' / invitation.number
    with changing(store):
        up = is_up(invitation)
        if owner is None or up and launch_process(folder) == (1, True):
            owner = {'pid': 1, 'pid_start': process_start(1) or 0, 'boot': boot_id()}
        other = other_vpn(invitation, store)
        if up and stored_vpn(folder) == other and secret_of(folder) == invitation.secret:
            if owner['pid'] == 1 or not is_held(folder):
                write_private(folder / 'process.json', to_json(owner).encode())
            return folder
        if not invitation.private and not agreed(
                f'{invitation.network} has public addresses. Send what is for them to the '
                f"computer that wrote this invitation, '{invitation.machine}' at "
                f'{invitation.endpoint}?'):
            raise ConfigurationError(
                f"the invitation to '{invitation.machine}' would take the public addresses "
                f'{invitation.network}',
                'ros2 fog join in a terminal asks whether you want that; a launch does not')
        check_robot()
        before = store.other_vpns().get(invitation.machine, folder)
        if before != folder:
            _check_left(before, invitation)
            # of a launch with this machine that has ended, or of this machine before
            clear(before)
        if not up:
            _check_free(invitation, store)
        # not the port that the user chose: that is for the robot's end of a launch's own VPN
        interface = dataclasses.replace(other.own, port=addresses.choose_port())
        vpn: Vpn = plugin_system.load('fogros2.vpn', 'wireguard')(
            ports=vendor.ports, asked=addresses_of(vendor.asked(environment)))
        private = base64.b64encode(key).decode()
        store.launch_folder(invitation.number)
        write = functools.partial(_write, folder, invitation, other, vendor, environment, owner)
        try:
            if not up:  # else the former ones hold until the interface has changed
                write()
            if helped.made(interface):
                process.run(helped.lend(interface, private), timeout=Timeouts().vpn)
            else:
                write_private(Path(interface.key_file), f'{private}\n'.encode())
            run(vpn.up(interface, [other.machine]), timeout=Timeouts().vpn)
            if up:
                write()
        except BaseException:
            if not up:
                clear(folder)
            raise
        return folder


@contextlib.contextmanager
def changing(store: Store) -> Iterator[None]:
    """Wait until no other terminal or launch of this user joins or leaves a VPN."""
    lock = os.open(make_folder(store.root / 'launches'), os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def other_vpn(invitation: Invitation, store: Store) -> OtherVpn:
    """Return the VPN that an invitation leads to."""
    name = f'fog{invitation.number}'
    return OtherVpn(
        Peer(invitation.machine, invitation.key, invitation.address, invitation.endpoint),
        VpnInterface(invitation.interface, invitation.address, invitation.network, 0, ''),
        VpnInterface(
            name, invitation.joiner, invitation.network, 0,
            helped.key_file(name) if helped.permitted()
            else str(store.root / 'launches' / invitation.number / 'vpn.key'), firewall=True),
        network.heartbeats(invitation.joiner))


def secret_of(folder: Path) -> str:
    """Return the secret of the invitation by which this computer has joined, '' for none."""
    return path.read_text() if (path := folder / DOOR_KEY).exists() else ''


def is_up(invitation: Invitation) -> bool:
    """Return whether this computer's end of a machine's VPN exists."""
    return Path('/sys/class/net', f'fog{invitation.number}').exists()


def is_held(folder: Path) -> bool:
    """Return whether the process that has joined still runs, or this computer joined by hand."""
    return launch_process(folder)[1]


def check_rmw(rmw: str) -> None:
    """
    Check that a guest's nodes can use the launch's middleware.

    :raises ConfigurationError: they would need a router of their own.
    """
    if rmw == 'rmw_zenoh_cpp':
        raise ConfigurationError('a second computer cannot join a launch with rmw_zenoh_cpp',
                                 'launch with Cyclone DDS or Fast DDS: unset RMW_IMPLEMENTATION')


def _vendor(invitation: Invitation, environment: Mapping[str, str]) -> DdsVendor:
    check_rmw(invitation.rmw)
    if invitation.rmw not in plugin_system.names('fogros2.dds'):
        raise DdsError(f'FogROS2 does not support RMW_IMPLEMENTATION={invitation.rmw}')
    vendor: DdsVendor = plugin_system.load('fogros2.dds', invitation.rmw)(
        domain=invitation.domain)
    return vendor


def _check_left(folder: Path, invitation: Invitation) -> None:
    """
    Check that nothing here uses the VPN of another machine with the name of an invitation's.

    :raises ConfigurationError: a launch uses it, or it was joined by hand at another endpoint.
    """
    name, (pid, alive) = invitation.machine, launch_process(folder)
    if alive and pid != 1:
        raise ConfigurationError(f"a launch here uses another machine '{name}'", 'end it first')
    before = stored_vpn(folder)
    if alive and before is not None and before.machine.endpoint != invitation.endpoint:
        raise ConfigurationError(f"this computer has joined another machine '{name}'",
                                 f'ros2 fog leave {name} leaves that one')


def _launch(interface: str) -> str:
    """Return the part of a machine's interface name that all machines of its launch have."""
    return interface.rpartition('m')[0]


def _check_free(invitation: Invitation, store: Store) -> None:
    """
    Check that no network of this computer has addresses of the VPN.

    :raises ConfigurationError: this computer has joined another machine of the same launch.
    :raises VpnError: one has.
    """
    used = addresses.parse_used(run([addresses.used_networks()], timeout=Timeouts().vpn))
    if overlaps := addresses.overlapping(invitation.network, used):
        for name, folder in store.other_vpns().items():
            other = stored_vpn(folder)
            if other is not None and other.own.network == invitation.network and \
                    _launch(other.interface.name) == _launch(invitation.interface):
                raise ConfigurationError(
                    f"this computer is in the VPN of '{invitation.machine}' already, by '{name}'",
                    'a computer can join one machine of a launch: '
                    f'ros2 fog leave {name} leaves that one')
        raise VpnError(
            f"the VPN of '{invitation.machine}' has the addresses {invitation.network}, and this "
            f'computer uses {overlaps[0]}',
            f'{addresses.POOL_VARIABLE} on the inviting robot names another range: launch again')


def _write(
    folder: Path, invitation: Invitation, other: OtherVpn, vendor: DdsVendor,
    environment: Mapping[str, str], owner: Mapping[str, object],
) -> None:
    """Write the files of a launch's folder that terminals read, and the invitation."""
    lan = vendor.parse_lan(run([vendor.ask_lan()], timeout=Timeouts().vpn))
    interfaces = vendor.robot_interfaces(
        other.own.address if vendor.by_address else other.own.name, lan, environment)
    for name, content in {
            vendor.file_name: vendor.render(
                interfaces, [invitation.address] if vendor.asks_machines else [], environment,
                quiet=True),
            'domain': str(invitation.domain), 'rmw': vendor.rmw,
            'process.json': to_json(owner), DOOR_KEY: invitation.secret,
            OTHER_VPN: to_json(other)}.items():
        write_private(folder / name, content.encode())


def leave(name: str, store: Store) -> None:
    """
    Delete this computer's end of a machine's VPN; nodes that use it have to end before.

    :raises ConfigurationError: this computer has not joined the machine.
    """
    with changing(store):
        folders = store.other_vpns()
        if name not in folders:
            raise ConfigurationError(
                f"this computer has not joined a machine '{name}'",
                did_you_mean(name, [*folders], 'ros2 fog join INVITATION joins one'))
        clear(folders[name])
