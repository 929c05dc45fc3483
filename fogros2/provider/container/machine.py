# SPDX-License-Identifier: Apache-2.0
"""Name and label containers, and convert an engine's report of one to a Machine; pure."""

from __future__ import annotations

from collections.abc import Mapping
import datetime
import hashlib
import os
from pathlib import Path
import re
from typing import Any, Optional

from fogros2.errors import MachineNotFound
from fogros2.model import Endpoint, Machine, MachineState
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container import entry as container_entry
from fogros2.provider.container.engine import Engine

#: Labels besides the core's tags.
ATTEMPT = 'fogros2-token'
LOGIN = 'fogros2-login'
MACHINE = 'fogros2-machine'
#: The name of its folder, by which ``may_create`` recognises the engine's command.
DIRECTORY = 'fogros2-directory'
ENDS_STOPPED = 'fogros2-ends-stopped'
VPN_PORT = 'fogros2-vpn-port'
#: Tag of a machine that another computer has on this one; its value ends the container's name.
HOSTED = 'fogros2-hosted'
_OURS = (ATTEMPT, LOGIN, MACHINE, DIRECTORY, ENDS_STOPPED, VPN_PORT)

#: Roots of machines without an image; the engine removes each with its container.
ROOTS = Path('/var/lib/fogros2')
#: Folders by which machines here meet: of each user of this computer, of each machine.
SHARED = Path('/var/lib/fogros2-share')
#: A machine's id: its engine, its container's id, its token.
ID = re.compile(r'(podman|docker):([0-9a-f]{12}):([A-Za-z0-9_-]{1,64})')

_STATES = {
    'created': MachineState.PENDING, 'configured': MachineState.PENDING,
    'initialized': MachineState.PENDING, 'restarting': MachineState.PENDING,
    'running': MachineState.RUNNING, 'paused': MachineState.RUNNING,
    'stopping': MachineState.STOPPING, 'removing': MachineState.STOPPING,
    'exited': MachineState.STOPPED, 'stopped': MachineState.STOPPED,
    'dead': MachineState.STOPPED,
}


def container_name(machine: str, tags: Mapping[str, str] = {}) -> str:
    """Return the name of a machine's container; robots that share a host have different ones."""
    return f"fogros2-{machine}{tags.get(HOSTED, '')}"


def volume_name(name: str) -> str:
    """Return the engine's name of a volume."""
    return f'fogros2-volume-{name}'


def directory(token: str) -> Path:
    """
    Return the folder of the root of the machine with this token, which its name does not tell.

    :raises MachineNotFound: the token is not ours, so that no other folder is ever removed.
    """
    if not re.fullmatch(r'[A-Za-z0-9][A-Za-z0-9_-]{3,63}', token):
        raise MachineNotFound(f"'{token}' is no token of a container machine")
    return ROOTS / hashlib.sha256(token.encode()).hexdigest()[:16]


def token_label(token: str) -> str:
    """Return the line of a file with the label of a machine's token."""
    return f'{ATTEMPT}={token}\n'


def share_folder(token: str) -> Path:
    """Return the folder of a machine that others see; the one above is of all that meet."""
    return SHARED / str(os.getuid()) / directory(token).name


def host_key_file(token: str) -> Path:
    """Return the path at which a machine without an image writes its public host key."""
    return directory(token) / 'root' / f'{container_entry.HOST_KEY}.pub'


def parse_id(machine_id: str) -> tuple[Engine, str, str]:
    """
    Return the engine, the container's id and the token of a machine's id.

    :raises MachineNotFound: it is no id of this provider.
    """
    match = ID.fullmatch(machine_id)
    if not match:
        raise MachineNotFound(f"'{machine_id}' is no container machine")
    return container_engine.named(match[1]), match[2], match[3]


def machine_id(engine: Engine, identity: str, token: str) -> str:
    """Return a machine's id, which contains its engine and its token."""
    return f'{engine.name}:{identity[:12]}:{token}'


def labels_of(entry: Mapping[str, Any]) -> dict[str, str]:
    """Return the labels of a container."""
    return dict(entry['Config']['Labels'] or {})


def name_of(entry: Mapping[str, Any]) -> str:
    """Return the name of a container's machine; the container's own if it is no machine's."""
    return labels_of(entry).get(MACHINE) or str(entry['Name']).lstrip('/')


def address_of(entry: Mapping[str, Any]) -> str:
    """Return the container's first address, or ''."""
    networks = (entry.get('NetworkSettings') or {}).get('Networks') or {}
    return next((str(n['IPAddress']) for n in networks.values() if n.get('IPAddress')), '')


def published(entry: Mapping[str, Any]) -> tuple[int, int]:
    """Return the published ports of a container's SSH and VPN port, 0 for none."""
    ports = (entry.get('NetworkSettings') or {}).get('Ports') or {}
    inside = '22/tcp', f'{labels_of(entry).get(VPN_PORT)}/udp'
    ssh, vpn = (int((ports.get(port) or [{'HostPort': 0}])[0]['HostPort']) for port in inside)
    return ssh, vpn


def timestamp(text: str) -> float:
    """Return an engine's time of creation in seconds since the epoch."""
    match = re.match(r'(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(\.\d{1,6})?\d*(Z|[+-]\d\d:\d\d)', text)
    if not match:
        return 0.0
    zone = '+00:00' if match[3] == 'Z' else match[3]
    fraction = (match[2] or '.0').ljust(7, '0')
    return datetime.datetime.fromisoformat(f'{match[1]}{fraction}{zone}').timestamp()


def state_of(entry: Mapping[str, Any]) -> MachineState:
    """Return the state of a container."""
    return _STATES.get(str(entry['State']['Status']), MachineState.PENDING)


def machine_of(engine: Engine, entry: Mapping[str, Any], host_key: Optional[str]) -> Machine:
    """
    Return an engine's report of a container as a Machine.

    :param host_key: the machine's public host key, None while it has none.
    """
    labels = labels_of(entry)
    address = address_of(entry)
    port, vpn_port = published(entry) if HOSTED in labels else (22, 0)
    endpoint = None
    if host_key and address:
        endpoint = Endpoint('ssh', address, port, labels[LOGIN], host_key)
    return Machine(
        id=machine_id(engine, str(entry['Id']), labels[ATTEMPT]), name=labels.get(MACHINE, ''),
        provider='container', state=state_of(entry), created=timestamp(str(entry['Created'])),
        endpoint=endpoint, vpn_host=address, vpn_port=vpn_port,
        image=entry['Config'].get('Image') or '',
        tags={key: value for key, value in labels.items() if key not in _OURS},
        end_command=container_entry.END_COMMAND)
