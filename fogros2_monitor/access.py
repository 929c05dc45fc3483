# SPDX-License-Identifier: Apache-2.0
"""Connect the command line to the Foxglove bridge of a machine."""

from __future__ import annotations

import contextlib
from pathlib import Path
import re
import socket
from typing import Optional

from fogros2 import untrusted
from fogros2.deploy.machine_job import AGENT_FOLDER
from fogros2.errors import AgentError, CommandError, ConfigurationError, DeadlineExceeded
from fogros2.model import Command
from fogros2.shell import Shell
from fogros2.store import Store
from fogros2_monitor import accounts, addresses, credentials
from ros2fog_cli.api import machines
from ros2fog_cli.api.machines import Entry

#: Time-out of the answer of the machine's gate, in seconds.
_TIMEOUT = 15.0
#: The form of ``credentials.make_token``.
_TOKEN = re.compile('[A-Za-z0-9_-]{1,100}')


def on_robot(name: str) -> Optional[tuple[int, str]]:
    """Return port and token of the bridge of a machine that this robot replaces, or None."""
    folder = addresses.on_robot(Store(), name)
    paths = [path for path in folder.glob('monitor-*/*/token') if addresses.is_used(path.parent)]
    # of two launches with one port, the first one's gate has it
    for path in sorted(paths, key=lambda path: path.stat().st_mtime):
        port = int(path.parts[-3].partition('-')[2])
        with contextlib.suppress(OSError), socket.create_connection(
                ('127.0.0.1', port), timeout=_TIMEOUT) as link:
            # the gate may have found its port taken
            if not accounts.is_strangers(link):
                return port, path.read_text().strip()
    return None


def token_of(entry: Entry, shell: Shell, port: int) -> str:
    """
    Return the token of the bridge at a machine's port.

    :raises AgentError: no bridge has created a token.
    """
    record = entry.record
    folder = (record.agent if record is not None else '') \
        or machines.load(entry.provider).capabilities.agent_directory \
        or f'{AGENT_FOLDER}/{entry.name}'
    return _read(entry, shell, ('sh', '-c', 'cat "$1"/*/token', 'sh',
                                str(Path(addresses.folder_of(folder, port, '')))))[0]


def no_bridge(machine: str) -> ConfigurationError:
    """Return the error for a machine without a bridge."""
    return ConfigurationError(
        f"'{machine}' has no Foxglove bridge",
        'launch_foxglove=True of the machine, or a Foxglove action, starts one')


def credentials_of(entry: Entry, shell: Shell) -> tuple[str, str, str]:
    """
    Return the open address of the bridge (``host:port``), its token, its certificate's SHA-256.

    :raises ConfigurationError: there is no bridge, or it is not open to other computers.
    :raises AgentError: no running launch of this robot serves the bridge, or it has no token yet.
    """
    record = entry.record
    port = 0 if record is None else addresses.port_of(record.notes)
    if record is not None and record.launch_alive and not port:
        raise no_bridge(entry.name)
    if record is None or not record.launch_alive or not record.agent:
        raise AgentError(f"no launch of this robot serves the topics of '{entry.name}' now",
                         'ros2 fog list shows the robot of the machine')
    where = record.notes.get(addresses.NOTE_OPEN)
    if not where:
        raise ConfigurationError(
            f"only this robot may watch '{entry.name}'",
            "monitor_allow=['198.51.100.0/28'] in its launch file lets others in")
    made = credentials.Credentials(Path(
        addresses.folder_of(record.agent, port, record.launch)))
    token, certificate = _read(entry, shell, ('cat', str(made.token), str(made.certificate)))
    try:
        return where, token, credentials.fingerprint(certificate)
    except ValueError as error:
        raise _wrong(entry, 'certificate') from error


def _read(entry: Entry, shell: Shell, words: tuple[str, ...]) -> tuple[str, str]:
    """Run a command that prints the token, and return the token and what follows it."""
    try:
        token, _, rest = shell.run(Command(words, sudo=True, what='read the token'),
                                   timeout=_TIMEOUT).stdout.partition('\n')
        return untrusted.matched(_TOKEN, token.strip()), rest
    except untrusted.InvalidMessage as error:
        raise _wrong(entry, 'token') from error
    except CommandError as error:
        raise AgentError(f"'{entry.name}' has no token yet, or can't make one: {error}",
                         f'ros2 fog logs {entry.name}') from error
    except DeadlineExceeded as error:
        raise DeadlineExceeded(
            str(error.args[0]),
            f'the machine is busy or out of reach: ros2 fog status {entry.name}') from error


def _wrong(entry: Entry, what: str) -> AgentError:
    return AgentError(f"'{entry.name}' sent an invalid {what}",
                      'the machine may be hijacked: delete it')
