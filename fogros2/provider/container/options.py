# SPDX-License-Identifier: Apache-2.0
"""Parse the options of a container machine, and convert them to the engine's flags."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
import os
from pathlib import Path
import re
from typing import Any

from fogros2 import untrusted
from fogros2.errors import ConfigurationError
from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container.engine import Engine
from fogros2.provider.container.entry import FOLDER
from fogros2.provider.container.machine import (
    container_name,
    DIRECTORY,
    directory,
    ENDS_STOPPED,
    LOGIN,
    MACHINE,
    share_folder,
    volume_name,
    VPN_PORT,
)
from fogros2.provider.options import parsed

#: Folders on the machine by which programs of several machines meet: its own, and that of all.
SHARE_FOLDERS = (f'/{FOLDER}/share', f'/{FOLDER}/shared')
APPARMOR = Path('/sys/kernel/security/apparmor')


@dataclasses.dataclass(frozen=True)
class Options:
    """
    The options of a container machine in a launch file.

    :param image: name of an image; '' for a machine without one (podman only), which uses this
        computer's own root.
    :param engine: auto, podman or docker.
    :param user: login user, created with sudo rights and no password.
    :param network: a network of the engine; '' for its default.
    :param cpus: number of CPUs, such as 1.5.
    :param memory: such as '2g'.
    :param gpus: 'all' or a number, as in ``docker run --gpus``.
    :param devices: such as '/dev/video0'.
    :param ports: such as '8080:80' or '8080:80/udp'.
    :param mounts: read-only folders: 'path' or 'path:path on the machine'.
    :param containers: whether the machine may run containers.
    :param isolated: whether the machine gets the root of a new system instead of this computer's.
    """

    image: str = ''
    engine: str = 'auto'
    user: str = 'fog'
    network: str = ''
    cpus: float = 0.0
    memory: str = ''
    gpus: str = ''
    devices: tuple[str, ...] = ()
    ports: tuple[str, ...] = ()
    mounts: tuple[str, ...] = ()
    containers: bool = False
    isolated: bool = False

    @classmethod
    def parse(cls, given: Mapping[str, Any]) -> Options:
        """
        Return the options of a spec.

        :raises ConfigurationError: an option is unknown (with the nearest name) or invalid.
        """
        options = parsed(cls, given, 'a container machine')
        _check_values(options)
        return options


def _check_values(options: Options) -> None:
    if options.engine not in ('auto', *container_engine.ENGINES):
        raise ConfigurationError(f"there is no container engine '{options.engine}'",
                                 'engine= takes auto, podman or docker')
    if options.engine == 'docker' and not options.image:
        raise ConfigurationError("docker can't use this computer's own root",
                                 "name an image with image='...', or take engine='podman'")
    if not untrusted.NAME.fullmatch(options.user):
        raise ConfigurationError(
            f"'{options.user}' can't be a user name",
            'user= takes small letters, digits, - and _, beginning with a letter')
    for name in ('image', 'network', 'memory'):
        word = getattr(options, name)
        # The engine would parse it as an option.
        if word.startswith('-') or any(c.isspace() for c in word):
            raise ConfigurationError(f"option '{name}' can't be '{word}'",
                                     'it is one word, and none that begins with a hyphen')
    if options.memory and not re.fullmatch(r'(?i)[0-9]+([.][0-9]+)?([bkmg]|[kmg]b)|[0-9]{7,}',
                                           options.memory):
        raise ConfigurationError(f"'{options.memory}' is no amount of memory",
                                 "memory= takes '2g' or '512m'")
    if options.gpus and not re.fullmatch('all|[0-9]+', options.gpus):
        raise ConfigurationError(f"gpus= can't be '{options.gpus}'", "it takes 'all' or a number")
    for port in options.ports:
        _check_port(port)
    for device in options.devices:
        if not os.path.exists(device.split(':')[0]):
            raise ConfigurationError(f"there is no device '{device.split(':')[0]}' here",
                                     "devices= takes such as '/dev/video0'")
    for mount in options.mounts:
        source = mount.split(':')[0]
        if mount.count(':') > 1 or '/..' in mount or not all(map(os.path.isabs, mount.split(':'))):
            raise ConfigurationError(f"mounts= can't hold '{mount}'",
                                     "it takes '/path' or '/path:/path there'")
        if not os.path.exists(source):
            raise ConfigurationError(f"'{source}' of mounts= doesn't exist",
                                     'make it, or correct the path: it is one on this computer')


def _check_port(port: str) -> None:
    """Check the form ``[address:][host port:]port[/udp]``; ports may be ranges."""
    ports = '([0-9]+)(?:-([0-9]+))?'
    match = re.fullmatch(
        rf'(?:[0-9]+(?:[.][0-9]+){{3}}:)?(?:{ports}:)?{ports}(?:/(?:tcp|udp|sctp))?', port)
    numbers = [int(number) for number in match.groups() if number] if match else []
    if not numbers or not all(0 < number < 65536 for number in numbers):
        raise ConfigurationError(f"ports= can't hold '{port}'",
                                 "it takes '8080:80' or '8080:80/udp', numbers from 1 to 65535")


def common_flags(
    engine: Engine, spec: MachineSpec, request: CreateRequest, options: Options,
) -> Iterator[str]:
    """Yield the engine's flags for a spec, with or without an image; the token is not in them."""
    yield from ('--name', container_name(spec.name, request.tags), '--hostname', spec.name)
    labels = {
        **request.tags, LOGIN: options.user, MACHINE: spec.name,
        DIRECTORY: directory(request.token).name, VPN_PORT: str(request.vpn_port),
    }
    if spec.on_exit == 'stop':
        labels[ENDS_STOPPED] = 'yes'
    for key, value in labels.items():
        yield from ('--label', f'{key}={value}')
    # Only what WireGuard needs; ping needs NET_RAW, sshd's log AUDIT_WRITE.
    for right in ('NET_ADMIN', 'NET_RAW', 'AUDIT_WRITE', 'MKNOD'):
        yield from ('--cap-add', right)
    yield from ('--device', '/dev/net/tun')
    if engine.name == 'podman':
        # Only the machine's name, not the names in this computer's /etc/hosts, as docker does it.
        yield '--no-hosts'
    yield from container_engine.limits()
    # as on every other computer, half of the memory: the engines' 64 MB end nodes by SIGBUS
    yield from ('--shm-size', str(os.sysconf('SC_PHYS_PAGES') // 2 * os.sysconf('SC_PAGE_SIZE')))
    # podman's 2048 are too few for libraries with a thread for each of many processors
    threads = min(int(Path('/proc/sys/kernel', name).read_text())
                  for name in ('pid_max', 'threads-max'))
    yield from ('--pids-limit', str(threads // 2))
    if options.network:
        yield from ('--network', options.network)
    if options.cpus:
        yield from ('--cpus', f'{options.cpus:g}')
    if options.memory:
        yield from ('--memory', options.memory)
    if options.gpus:
        yield from gpu_flags(engine, options.gpus)
    for device in options.devices:
        yield from ('--device', device)
    for port in options.ports:
        yield from ('-p', port)
    if request.common:
        folder, (own, others) = share_folder(request.token), SHARE_FOLDERS
        yield from ('-v', f'{folder}/own:{own}', *data_mount(engine, folder.parent, others))
    for mount in options.mounts:
        source, _, target = mount.partition(':')
        yield from ('-v', f'{source}:{target or source}:ro')
    for name, (path, _) in request.with_volumes.items():
        yield from ('-v', f'{volume_name(name)}:{path}')
    if spec.on_exit != 'stop':
        yield '--rm'
    if options.containers:
        yield from nested_flags(engine)


def gpu_flags(engine: Engine, gpus: str) -> Iterator[str]:
    """Yield the flags for 'all' GPUs or a number of them."""
    if engine.name == 'docker':
        # an image that names none gets neither video encoders nor graphics
        yield from ('--gpus', gpus, '-e', 'NVIDIA_DRIVER_CAPABILITIES=all')
        return
    # Podman names each GPU by the vendor's description (CDI).
    for gpu in range(int(gpus)) if gpus.isdecimal() else [gpus]:
        yield from ('--device', f'nvidia.com/gpu={gpu}')


def data_mount(engine: Engine, folder: Path, target: str) -> tuple[str, str]:
    """Return the flag that shows a folder of others, whose programs and devices are none there."""
    options = 'ro,nosuid,nodev,noexec'
    if engine.name == 'podman':
        return '-v', f'{folder}:{target}:{options}'
    # only a volume of docker takes them, and a nameless one goes with its container
    return '--mount', (
        f'type=volume,volume-nocopy,volume-opt=type=none,volume-opt=device={folder},'
        f'"volume-opt=o=bind,{options}",dst={target}')


def nested_flags(engine: Engine) -> Iterator[str]:
    """
    Yield the flags that an engine in the machine needs: to mount, and to store layers.

    Masked paths and, with podman, the filter of system calls remain.
    """
    yield from ('--cap-add', 'SYS_ADMIN', '-v', '/var/lib/containers')
    if APPARMOR.exists():
        # Its usual profile forbids mounts.
        yield from ('--security-opt', 'apparmor=unconfined')
    if engine.name == 'docker':
        # Its filter forbids containers to change their root.
        yield from ('--security-opt', 'seccomp=unconfined')
