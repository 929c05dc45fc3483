# SPDX-License-Identifier: Apache-2.0
"""The robot's own part: what it needs to have, and what a dead launch left on it."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import threading

from fogros2 import plugin_system, process, ros2_daemon
from fogros2.errors import PrerequisiteError
from fogros2.provider import Provider
from fogros2.report import Reporter, silent, step
from fogros2.store import Record, Store
from fogros2.vpn import helped, Vpn
from fogros2.waiting import Timeouts

#: Programs that the robot's side calls, and the Debian packages that have them.
ROBOT_PROGRAMS = {
    'ip': 'iproute2', 'wg': 'wireguard-tools', 'nft': 'nftables', 'rsync': 'rsync',
    'ssh-keygen': 'openssh-client',
}

#: Held while sudo may ask, so that two threads don't ask at once.
_ASKING = threading.Lock()


def provider(name: str) -> Provider:
    """
    Return the provider of that name.

    :raises ConfigurationError: there is none.
    """
    instance: Provider = plugin_system.load('fogros2.provider', name)()
    return instance


def check_robot() -> None:
    """
    Check that this computer can be the robot's end of a VPN.

    :raises PrerequisiteError: a program, a right or a device is missing.
    """
    process.require(list(ROBOT_PROGRAMS), package_of=ROBOT_PROGRAMS)
    if os.geteuid() != 0 and not helped.permitted():
        with _ASKING:
            check_sudo(ask=True)
    if not Path('/dev/net/tun').exists():
        raise PrerequisiteError('/dev/net/tun is missing on this computer', 'sudo modprobe tun')


def check_sudo(*, ask: bool = False) -> None:
    """
    Check that root's commands run without a question in the middle of a launch.

    :param ask: have sudo ask for its password now, where somebody sits at a terminal.
    :raises PrerequisiteError: they don't.
    """
    if process.which('sudo') is None:
        raise PrerequisiteError('a VPN interface takes root, and there is no sudo here',
                                'run the launch as root, or install sudo')
    trouble = process.sudo_trouble()
    if ask and trouble == process.PASSWORD and process.ask_for_ticket('for the VPN interface'):
        trouble = process.sudo_trouble()
    if trouble is not None:
        reason, remedy = trouble
        if Path(helped.HELPER).exists():
            remedy += f', or have an administrator put you into the group {helped.GROUP}'
        raise PrerequisiteError(f'a VPN interface takes root, and {reason}', remedy)


def cleanup(record: Record, store: Store, report: Reporter = silent) -> None:
    """
    Take away what a launch that died left on the robot for a machine that is gone.

    Its VPN interface with its program and filter, the launch's folder, the machine's folder with
    its keys. A launch that still runs keeps its own; idempotent.

    :raises FogError: something could not be taken away; the record stays then.
    """
    if record.robot_vpn is not None and record.launch and not record.launch_alive:
        with step(report, record.name, 'VPN interface'):
            ros2_daemon.stop(store.launch(record.launch))
            vpn: Vpn = plugin_system.load('fogros2.vpn', record.spec.vpn)()
            for command in vpn.down(record.robot_vpn):
                process.run(command, timeout=Timeouts().vpn)
            shutil.rmtree(store.launch(record.launch), ignore_errors=True)
    store.machine(record.name).delete()
