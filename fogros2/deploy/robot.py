# SPDX-License-Identifier: Apache-2.0
"""Check what the robot needs for a launch, and clean up after a launch that died."""

from __future__ import annotations

from collections.abc import Iterable
import os
from pathlib import Path
import re
import threading
from typing import Optional

from fogros2 import plan, plugin_system, process, ros2_daemon
from fogros2.errors import ConfigurationError, PrerequisiteError
from fogros2.model import Command
from fogros2.provider import Provider
from fogros2.store import delete_folder
from fogros2.vpn import helped, owner, Vpn
from fogros2.waiting import Timeouts

#: Programs that the robot's side calls, and the Debian packages that contain them.
ROBOT_PROGRAMS = {program: process.PACKAGES.get(program, program)
                  for program in ('ip', 'wg', 'nft', 'rsync', 'ssh-keygen')}
#: The device of ``wireguard-go`` and of container machines, and the remedy where it is missing.
TUN = Path('/dev/net/tun')
TUN_REMEDY = f'sudo modprobe tun; in a container: start it with --device {TUN}'

#: Held while sudo may ask for a password, so that only one thread asks.
_ASKING = threading.Lock()
#: Held while resources of a dead launch are deleted, which several of its machines may want.
_CLEARING = threading.Lock()


def provider(name: str) -> Provider:
    """
    Return the provider with this name.

    :raises ConfigurationError: there is no such provider, or its class has another name.
    """
    instance: Provider = plugin_system.load('fogros2.provider', name)()
    if instance.name != name:  # its machines would have a provider that nobody finds
        raise ConfigurationError(
            f"the provider '{name}' can't be used: its class {type(instance).__name__} has the "
            f"name '{instance.name}'", 'its author has to give both the same name')
    return instance


def run(
    commands: Iterable[Command], *, timeout: float, cancel: Optional[threading.Event] = None,
) -> str:
    """Run commands on the robot, one after the other; return the last one's output."""
    output = ''
    for command in commands:
        output = process.run(command, timeout=timeout, cancel=cancel).stdout
    return output


def check_robot() -> None:
    """
    Check that this computer can be the robot's end of a VPN.

    :raises PrerequisiteError: a program, a right or a device is missing.
    """
    process.require(list(ROBOT_PROGRAMS), package_of=ROBOT_PROGRAMS)
    check_net_admin()
    if not TUN.exists() and not kernel_wireguard():
        raise PrerequisiteError(f'{TUN} is missing on this computer', TUN_REMEDY)
    if os.geteuid() != 0 and not helped.permitted():
        with _ASKING:
            check_sudo(ask=True)


def check_net_admin() -> None:
    """
    Check that root has the right to create network interfaces, which containers lack.

    :raises PrerequisiteError: root has not.
    """
    rights = re.search(r'^CapBnd:\s*(\w+)', Path('/proc/self/status').read_text(), re.MULTILINE)
    if rights is not None and not int(rights[1], 16) & 1 << 12:  # <linux/capability.h>
        raise PrerequisiteError('a VPN interface needs NET_ADMIN, which this container lacks',
                                f'start the container with --cap-add NET_ADMIN --device {TUN}')


def kernel_wireguard() -> bool:
    """Return whether the kernel has WireGuard's module, so that an interface needs no TUN."""
    return Path('/sys/module/wireguard').exists() or process.which('modprobe') is not None \
        and process.run(Command(('modprobe', '-nq', 'wireguard')), timeout=10.0,
                        check=False).returncode == 0


def check_sudo(*, ask: bool = False) -> None:
    """
    Check that commands can run as root without a password prompt during a launch.

    :param ask: let sudo ask for its password now, if there is a terminal.
    :raises PrerequisiteError: commands cannot run as root without a prompt.
    """
    if process.which('sudo') is None:
        raise PrerequisiteError('a VPN interface needs root, and there is no sudo here',
                                'run the launch as root, or install sudo')
    trouble = process.sudo_trouble()
    # a version of sudo may say in other words that it wants a password
    if ask and trouble not in (None, process.NO_RIGHTS) \
            and process.ask_for_ticket('for the VPN interface'):
        trouble = process.sudo_trouble()
    if trouble is not None:
        reason, remedy = trouble
        helper = f'put you into the group {helped.GROUP}, or install the helper again after an ' \
            'update' if Path(helped.HELPER).exists() else 'install the helper (doc/install.md)'
        raise PrerequisiteError(f'a VPN interface needs root, and {reason}',
                                f'{remedy}, or have an administrator {helper}')


def firewall_trouble() -> Optional[tuple[str, str]]:
    """
    Return why the user's firewall may drop what comes through the VPN, and a remedy.

    :raises FogError: the firewall cannot be looked at.
    """
    rules = process.run(Command(('nft', '--terse', 'list', 'ruleset'), sudo=True),
                        timeout=10.0).stdout
    chains = dict.fromkeys(
        chain for table, text in re.findall(
            r'^table (?:ip|inet) (\S+) \{\n(.*?)^\}', rules, re.MULTILINE | re.DOTALL)
        if not table.startswith('fog')
        for chain, policy, rest in re.findall(
            r'^\tchain (\S+) \{\n\t\ttype filter hook input[^;]*; policy (\w+);\n(.*?)^\t\}',
            text, re.MULTILINE | re.DOTALL)
        if policy == 'drop' or re.search(
            r'^\t\t(counter packets \d+ bytes \d+ )?(drop|reject( with [^\n]*)?)\n\Z',
            rest, re.MULTILINE))
    if not chains or re.search(r'iifname "fog\*" .*(accept|(goto|jump) \S*trusted)', rules):
        return None
    return (f"this computer's firewall ({', '.join(chains)}) refuses by default: it has to let in "
            'DDS and ping from the interfaces fog*, or no topic of a machine arrives',
            'sudo ufw allow in on fog+ (firewalld: firewall-cmd --zone=trusted '
            '--add-interface=fog+; else: nft insert rule inet filter input iifname "fog*" accept)')


def clear(folder: Path) -> None:
    """
    Delete the VPN interface, firewall rules, key and folder of a dead launch; idempotent.

    The ROS 2 daemon that it had is stopped before.

    :raises FogError: a resource could not be deleted.
    """
    with _CLEARING:
        name, own = f'fog{folder.name}', folder / 'vpn.key'
        key = helped.key_of(name) or str(own)
        if not own.exists() and not (owner.INTERFACES / name).exists() and helped.permitted():
            # nothing is left that needs root: its commands make the key first, and remove it last
            key = helped.key_file(name)
        interface = plan.robot_interface(folder.name, '127.0.0.0/24', 0, key, 0)
        ros2_daemon.stop(folder)
        vpn: Vpn = plugin_system.load('fogros2.vpn', 'wireguard')()
        run(vpn.down(interface), timeout=Timeouts().vpn)
        delete_folder(folder)
