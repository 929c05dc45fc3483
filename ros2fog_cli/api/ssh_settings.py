# SPDX-License-Identifier: Apache-2.0
"""
Write settings of OpenSSH for machines, so that other programs reach them by name.

Each file is in the folder of a machine's record, so it ends with the machine. One ``Include``
with a pattern in the user's configuration reads those that exist.
"""

from __future__ import annotations

import dataclasses
import glob
from pathlib import Path
import shlex

from fogros2.errors import MachineNotFound, ShellError, Unsupported
from fogros2.model import Endpoint
from fogros2.shell import ssh_config
from fogros2.store import Store, write_private
from fogros2.untrusted import one_line
from ros2fog_cli.api import machines, reach
from ros2fog_cli.api.machines import Entry

#: Names of the files in a machine's folder.
FILE, KNOWN_HOSTS = 'ssh_config', 'known_hosts'


def write(entry: Entry, store: Store) -> Path:
    """
    Write the settings of a machine as it can be reached now; return the file.

    :raises FogError: the machine does not run, or its shell is not SSH.
    """
    to = reach.endpoint(entry)
    if to.kind != 'ssh':
        raise Unsupported(f"'{entry.name}' has no SSH server that this computer reaches",
                          f'ros2 fog connect {entry.name}')
    if not store.exists(entry.name):
        raise Unsupported(f"this robot has no key of '{entry.name}'",
                          'only the robot that launched the machine has one')
    if machines.load(entry.provider).capabilities.firewall:
        to = reach.through_vpn(entry, to) or to
    folder = store.machine(entry.name)
    text = settings(entry.name, to, folder)
    if to.host_key:
        write_private(folder / KNOWN_HOSTS, f'{label(entry.name)} {to.host_key}\n'.encode())
    write_private(folder / FILE, text.encode())
    if not store.exists(entry.name):
        # its launch has deleted the folder, which is there again
        with store.lock(entry.name):
            store.delete(entry.name)
        raise MachineNotFound(f"'{entry.name}' has ended meanwhile",
                              'ros2 fog list shows the machines that exist')
    return folder / FILE


def label(name: str) -> str:
    """Return the name of a machine in its file of known hosts."""
    return f'fogros2-{name}'


def settings(name: str, to: Endpoint, folder: Path) -> str:
    """
    Return the settings of a machine, in the form of ssh_config(5).

    :param folder: where the file with its host key is.
    :raises ShellError: a value would be several settings.
    """
    config = ssh_config.of(to)
    host = to.host if to.host_key else config.host
    pairs = [('HostName', host.replace('%', '%%')), ('Port', str(config.port)),
             ('User', config.user),
             # not by the user's ProxyJump for all hosts, which the launch does not use either
             ('ProxyCommand', shlex.join(config.proxy).replace('%', '%%') or 'none')]
    if config.only_keys:
        pairs += [('IdentityFile', ssh_config.quoted(key)) for key in config.keys]
        pairs.append(('IdentitiesOnly', 'yes'))
    if to.host_key:
        config = dataclasses.replace(
            config, known_hosts=(str(folder / KNOWN_HOSTS),), label=label(name))
        pairs += [('UserKnownHostsFile', ssh_config.quoted(config.known_hosts[0])),
                  ('GlobalKnownHostsFile', '/dev/null'), ('StrictHostKeyChecking', 'yes')]
    elif to.alias:
        pairs.append(('UserKnownHostsFile', ' '.join(
            ssh_config.quoted(one) for one in config.known_hosts)))
    pairs.append(('HostKeyAlias', config.label))
    for key, value in (*pairs, ('host key', to.host_key or '')):
        if one_line(value) != value or \
                key in ('HostName', 'User') and ssh_config.MISREAD.search(value):
            raise ShellError(f"'{name}' has a {key} that ssh would misread: {value!r}",
                             'its host or its provider may be hijacked')
    return f'Host {name}\n' + ''.join(f'    {key} {value}\n' for key, value in pairs if value)


def include(store: Store) -> str:
    """Return the line for the user's configuration."""
    root = glob.escape(str(store.root.absolute())).replace('\\', 4 * '\\')
    # OpenSSH 10 expands '%h', and 9 does not read '%%' as '%'; both match it by '?'
    root = root.replace('%', '?')
    return f"Include {ssh_config.quoted(f'{root}/machines/*/{FILE}')}"


def included(line: str) -> bool:
    """Return whether the user's configuration has the line."""
    try:
        config = Path('~/.ssh/config').expanduser()
        return line in map(str.strip, config.read_text().splitlines())
    except (OSError, ValueError):
        return False
