# SPDX-License-Identifier: Apache-2.0
"""What a launch file may ask of a container machine, and the engine's words for it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
import os
import re
from typing import Any

from fogros2.errors import ConfigurationError
from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider import container_engine
from fogros2.provider.container_engine import Engine
from fogros2.provider.container_machine import (
    ATTEMPT,
    container_name,
    DIRECTORY,
    ENDS_STOPPED,
    LOGIN,
    MACHINE,
)
from fogros2.provider.options import convert, known


@dataclasses.dataclass(frozen=True)
class Options:
    """
    What a launch file may ask of a container.

    :param image: name of an image; '' for this computer's own root (podman alone).
    :param engine: auto, podman or docker.
    :param user: login user, made with sudo rights and no password.
    :param network: network of the engine's; '' for its default.
    :param ip: fixed address in that network.
    :param cpus: CPUs' worth of time, such as 1.5.
    :param memory: such as '2g'.
    :param gpus: 'all' or a number, as ``docker run --gpus`` takes it.
    :param devices: such as '/dev/video0'.
    :param ports: such as '8080:80' or '8080:80/udp'.
    :param mounts: folders visible there read-only: 'path' or 'path:path there'.
    :param env: variables of every login.
    """

    image: str = ''
    engine: str = 'auto'
    user: str = 'fog'
    network: str = ''
    ip: str = ''
    cpus: float = 0.0
    memory: str = ''
    gpus: str = ''
    devices: tuple[str, ...] = ()
    ports: tuple[str, ...] = ()
    mounts: tuple[str, ...] = ()
    env: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def parse(cls, given: Mapping[str, Any]) -> Options:
        """
        Return the options of a spec.

        :raises ConfigurationError: one is unknown (with the nearest name) or makes no sense.
        """
        fields = {field.name: field for field in dataclasses.fields(cls)}
        options_given = known(given, fields, 'a container machine')
        options = cls(**{
            name: convert(name, value, {} if name == 'env' else fields[name].default)
            for name, value in options_given.items()})
        _check_values(options)
        return options


def _check_values(options: Options) -> None:
    if options.engine not in ('auto', *container_engine.ENGINES):
        raise ConfigurationError(f"there is no container engine '{options.engine}'",
                                 'engine= takes auto, podman or docker')
    if options.engine == 'docker' and not options.image:
        raise ConfigurationError("docker can't use this computer's own root",
                                 "name an image with image='...', or take engine='podman'")
    if not re.fullmatch(r'[a-z_][a-z0-9_-]{0,31}', options.user):
        raise ConfigurationError(f"'{options.user}' can't be a user name")
    for name in ('image', 'network', 'ip', 'memory', 'gpus'):
        word = getattr(options, name)
        # the engine would take it for an option of its own
        if word.startswith('-') or any(c.isspace() for c in word):
            raise ConfigurationError(f"option '{name}' can't be '{word}'")
    if options.ip and not options.network:
        raise ConfigurationError('ip= fixes an address in a network', "give network='...' too")
    for name, value in options.env.items():
        if not re.fullmatch(r'[A-Za-z_][A-Za-z0-9_]*', name) or '"' in value or '\n' in value:
            raise ConfigurationError(f"env= can't carry the variable {name!r}")
    for mount in options.mounts:
        source = mount.split(':')[0]
        if mount.count(':') > 1 or not os.path.isabs(source) or '/..' in mount:
            raise ConfigurationError(f"mounts= can't hold '{mount}'",
                                     "it takes '/path' or '/path:/path there'")
        if not os.path.exists(source):
            raise ConfigurationError(f"'{source}' of mounts= doesn't exist")


def mount_flag(mount: str) -> str:
    """Return the engine's form of a read-only mount."""
    source, _, target = mount.partition(':')
    return f'{source}:{target or source}:ro'


def common_flags(
    engine: Engine, spec: MachineSpec, request: CreateRequest, options: Options,
) -> Iterator[str]:
    """Yield the engine's words for what a spec asks, with an image or without."""
    yield from ('--name', container_name(spec.name), '--hostname', spec.name)
    labels = {
        **request.tags, ATTEMPT: request.token, LOGIN: options.user, MACHINE: spec.name,
        DIRECTORY: '' if options.image else 'root',
    }
    if spec.on_exit == 'stop':
        labels[ENDS_STOPPED] = 'yes'
    for key, value in labels.items():
        yield from ('--label', f'{key}={value}')
    # what WireGuard needs, and no more; ping takes NET_RAW, sshd's log AUDIT_WRITE
    for right in ('NET_ADMIN', 'NET_RAW', 'AUDIT_WRITE', 'MKNOD'):
        yield from ('--cap-add', right)
    yield from ('--device', '/dev/net/tun')
    # the machine's name alone, not the names this computer's /etc/hosts knows
    yield '--no-hosts'
    yield from container_engine.limits()
    if options.network:
        yield from ('--network', options.network)
    if options.ip:
        yield from ('--ip', options.ip)
    if options.cpus:
        yield from ('--cpus', f'{options.cpus:g}')
    if options.memory:
        yield from ('--memory', options.memory)
    if options.gpus:
        # podman takes them as what the vendor describes (CDI)
        yield from (('--gpus', options.gpus) if engine.name == 'docker' else
                    ('--device', f'nvidia.com/gpu={options.gpus}'))
    for device in options.devices:
        yield from ('--device', device)
    for port in options.ports:
        yield from ('-p', port)
