# SPDX-License-Identifier: Apache-2.0
"""Machines on this computer: podman or docker containers with an SSH server of their own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
import datetime
import json
import os
from pathlib import Path
import re
import threading
from typing import Any, ClassVar, Optional

from fogros2 import process
from fogros2.errors import (
    CommandError,
    ConfigurationError,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
    ProviderError,
    Unsupported,
)
from fogros2.model import (
    Command,
    CreateRequest,
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
)
from fogros2.provider import container_engine, container_entry, container_root, Provider
from fogros2.provider.container_engine import Engine
from fogros2.provider.options import convert, known
from fogros2.waiting import wait_until

#: Labels beside the core's tags.
ATTEMPT = 'fogros2-token'
LOGIN = 'fogros2-login'
MACHINE = 'fogros2-machine'
DIRECTORY = 'fogros2-directory'
ENDS_STOPPED = 'fogros2-ends-stopped'

#: Roots of machines without an image; the engine removes each with its container.
ROOTS = Path('/var/lib/fogros2')

_STATES = {
    'created': MachineState.PENDING, 'configured': MachineState.PENDING,
    'initialized': MachineState.PENDING, 'restarting': MachineState.PENDING,
    'running': MachineState.RUNNING, 'paused': MachineState.RUNNING,
    'stopping': MachineState.STOPPING, 'removing': MachineState.STOPPING,
    'exited': MachineState.STOPPED, 'stopped': MachineState.STOPPED,
    'dead': MachineState.STOPPED,
}

#: File systems that can't hold the writable layer of an overlay.
_NO_UPPER = ('overlay', 'nfs', 'nfs4', 'cifs', 'vfat', 'exfat', 'ntfs', '9p', 'virtiofs', 'fuse')

# One process does all of it, in a session of its own: a launch that is killed meanwhile leaves
# either nothing or a machine that guards itself. From the fourth word on it is the engine's.
_CREATE = """\
top=$1 hook=$2 layers=$3
shift 3
engine=$1
umask 022
failed() {
    code=$?
    [ $code -eq 0 ] && return
    [ -s "$top/cid" ] && "$engine" rm -f "$(cat "$top/cid")" >/dev/null 2>&1
    rm -rf -- "$top"
    rmdir -- "${top%/*}" 2>/dev/null
    exit $code
}
tries=0
until mkdir "$top" 2>/dev/null; do
    # there already: another attempt with this token, or one that was cut short
    [ -e "$top" ] || [ $tries -gt 9 ] && exit 17  # as _THERE
    mkdir -p "${top%/*}"
    tries=$((tries + 1))
done
trap failed EXIT
mkdir "$top/root" "$top/hooks"
chmod 711 "$top"
[ -z "$hook" ] || echo "$hook" > "$top/hooks/remove.json"
for layer in $layers; do mkdir -p "$top/layers$layer/upper" "$top/layers$layer/work"; done
tar -xpf - --numeric-owner -C "$top/root"
"$@"
"""

#: What it exits with when the token has been used.
_THERE = 17

_DESTROY = """\
engine=$1 identity=$2 top=$3
"$engine" rm -f -t 0 "$identity" >&2 || "$engine" rm -f "$identity" >&2 || :
rm -rf -- "$top"
rmdir -- "${top%/*}" 2>/dev/null || :
"""


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


class ContainerProvider(Provider):
    """Containers of podman or docker on this computer."""

    name: ClassVar[str] = 'container'
    agent_directory: ClassVar[str] = f'/{container_entry.AGENT_DIRECTORY}'
    agent_program: ClassVar[str] = f'/{container_entry.FOLDER}/agent.py'

    def __init__(self) -> None:
        self._host_keys: dict[str, str] = {}
        self._lock = threading.Lock()

    def check(self, spec: MachineSpec) -> None:
        """Look for the engine, the rights, TUN, and what the root without an image needs."""
        options = Options.parse(spec.options)
        engine = container_engine.select(options.engine, options.image or None)
        if engine.sudo and os.geteuid() != 0:
            result = process.run(Command(('sudo', '-n', 'true')), timeout=10.0, check=False)
            if result.returncode != 0:
                raise PrerequisiteError(f'{engine.name} takes root on this computer',
                                        'run `sudo -v` first, or allow it without a password')
        if not os.path.exists('/dev/net/tun'):
            raise PrerequisiteError('there is no /dev/net/tun on this computer',
                                    'sudo modprobe tun')
        if not options.image:
            check_root()

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Create the container and start it; returns when the engine has started it."""
        options = Options.parse(spec.options)
        engine = container_engine.select(options.engine, options.image or None)
        try:
            if options.image:
                identity = self._create_from_image(engine, spec, request, options)
            else:
                identity = self._create_from_root(engine, spec, request, options)
        except ProviderError as error:
            identity = self._existing(engine, spec.name, request.token, error)
        return f'{engine.name}:{identity[:12]}:{request.token}'

    def _existing(
        self, engine: Engine, name: str, token: str, error: ProviderError,
    ) -> str:
        """Return the container that an earlier attempt with this token made, or raise."""
        found = engine.inspect([container_name(name)])
        if not found:
            raise error
        if labels_of(found[0]).get(ATTEMPT) != token:
            raise NameTaken(f"there is a container machine '{name}' already",
                            f'ros2 fog delete {name}') from error
        return str(found[0]['Id'])

    def _create_from_root(
        self, engine: Engine, spec: MachineSpec, request: CreateRequest, options: Options,
    ) -> str:
        top = directory(request.token)
        system = container_root.system_mounts()
        kept = spec.on_exit == 'stop'
        words = [*common_flags(spec, request, options)]
        for path in system:
            # the engine's own layer ends with the run; a machine that is stopped keeps its disk
            upper = f',upperdir={top}/layers{path}/upper,workdir={top}/layers{path}/work'
            words += ['-v', f"{path}:{path}:O{upper if kept else ''}"]
        for mount in container_root.environment_mounts(spec.workspace):
            words += ['-v', f'{mount}:{mount}:ro']
        for mount in options.mounts:
            words += ['-v', mount_flag(mount)]
        flags = list(engine.flags)
        if not kept:
            words.append('--rm')
            flags += hook_flags(top)
        archive = container_root.Archive()
        container_entry.add(
            archive, user=options.user, authorized_key=request.authorized_key,
            environment=options.env, agent_config=request.agent_config)
        command = Command(
            ('sh', '-ec', _CREATE, 'sh', str(top), '' if kept else removal_hook(top),
             ' '.join(system) if kept else '',
             engine.name, *flags, 'run', '-d', '--cidfile', f'{top}/cid', *words,
             '--rootfs', f'{top}/root', '/bin/sh', f'/{container_entry.FOLDER}/entry.sh'),
            sudo=engine.sudo, what=f"creating container machine '{spec.name}'",
            input=container_root.skeleton(options.user) + archive.data())
        try:
            return process.run(command, timeout=120.0).stdout.split()[-1]
        except CommandError as error:
            if error.result.returncode != _THERE:
                raise container_engine.translate(error) from error
            raise ProviderError(
                f'an attempt to create {spec.name} that was cut short left {top}',
                f'sudo rm -rf {top}') from error

    def _create_from_image(
        self, engine: Engine, spec: MachineSpec, request: CreateRequest, options: Options,
    ) -> str:
        words = [*common_flags(spec, request, options)]
        for mount in options.mounts:
            words += ['-v', mount_flag(mount)]
        if spec.on_exit != 'stop':
            words.append('--rm')
        archive = container_root.Archive()
        container_entry.add(
            archive, user=options.user, authorized_key=request.authorized_key,
            environment=options.env, agent_config=request.agent_config)
        what = f"creating container machine '{spec.name}' from {options.image}"
        identity = engine.call(
            'create', *words, '--user', '0:0', '--entrypoint', '/bin/sh', options.image,
            f'/{container_entry.FOLDER}/entry.sh', what=what, timeout=1800.0).stdout.split()[-1]
        try:
            engine.call('cp', '-', f'{identity}:/', what=what, data=archive.data())
            engine.call('start', identity, what=what)
        except BaseException:
            engine.call('rm', '-f', identity, what='removing it again', check=False)
            raise
        return identity

    def describe(self, machine_id: str) -> Machine:
        """Return what the engine knows of a container now."""
        engine, identity, _ = parse_id(machine_id)
        found = engine.inspect([identity])
        if not found:
            raise MachineNotFound(f'container {identity} does not exist any more')
        return self._machine(engine, found[0], complain=True)

    def find(self, tags: Mapping[str, str]) -> Iterator[Machine]:
        """Yield the containers that carry all of ``tags`` as labels, of both engines."""
        filters = [f'--filter=label={key}={value}' for key, value in tags.items()]
        for engine in container_engine.installed():
            listed = engine.call('ps', '-aq', f'--filter=label={ATTEMPT}', *filters,
                                 what='listing containers').stdout.split()
            if listed:
                for entry in engine.inspect(listed):
                    yield self._machine(engine, entry, complain=False)

    def destroy(self, machine_id: str) -> None:
        """Remove a container and its root; returns when both are gone."""
        engine, identity, token = parse_id(machine_id)
        result = process.run(
            Command(('sh', '-c', _DESTROY, 'sh', engine.name, identity, str(directory(token))),
                    sudo=engine.sudo, what=f'removing container {identity}'),
            timeout=60.0, check=False)
        if result.returncode == 0 and not result.stderr.strip():
            return
        if sudo := container_engine.sudo_hint(result.stderr):
            raise ProviderError(f'container {identity} was not removed', sudo)
        # the engine may be removing it this moment by itself
        wait_until(lambda: not engine.inspect([identity]), timeout=20.0,
                   what=f'container {identity} to be removed',
                   hint=container_engine.last_line(result.stderr))
        with self._lock:
            self._host_keys.pop(identity, None)

    def stop(self, machine_id: str) -> None:
        """Stop a container that was created with ``on_exit='stop'``; its disk stays."""
        engine, identity, _ = parse_id(machine_id)
        found = engine.inspect([identity])
        if not found:
            raise MachineNotFound(f'container {identity} does not exist any more')
        if ENDS_STOPPED not in labels_of(found[0]):
            raise Unsupported('a container made to be deleted at its end can not be stopped',
                              "create it with on_exit='stop'")
        engine.call('stop', '-t', '3', identity, what=f'stopping container {identity}')

    def start(self, machine_id: str) -> None:
        """Start a stopped container again."""
        engine, identity, _ = parse_id(machine_id)
        if not engine.inspect([identity]):
            raise MachineNotFound(f'container {identity} does not exist any more')
        engine.call('start', identity, what=f'starting container {identity}')

    def _machine(self, engine: Engine, entry: Mapping[str, Any], *, complain: bool) -> Machine:
        labels = labels_of(entry)
        identity = str(entry['Id'])[:12]
        token = labels[ATTEMPT]
        state = _STATES.get(str(entry['State']['Status']), MachineState.PENDING)
        address = address_of(entry)
        shell = None
        if state is MachineState.RUNNING and address:
            key = self._host_key(engine, identity, token, bool(labels.get(DIRECTORY)))
            if key:
                shell = Endpoint('ssh', address, 22, labels[LOGIN], key)
        elif state is MachineState.STOPPED and complain:
            self._complain(engine, identity)
        return Machine(
            id=f'{engine.name}:{identity}:{token}', name=labels.get(MACHINE, ''),
            provider=self.name, state=state, created=timestamp(str(entry['Created'])),
            shell=shell, vpn_host=address,
            tags={k: v for k, v in labels.items() if k not in (
                ATTEMPT, LOGIN, MACHINE, DIRECTORY, ENDS_STOPPED)},
            end_command=container_entry.END_COMMAND)

    def _host_key(self, engine: Engine, identity: str, token: str, own: bool) -> Optional[str]:
        """Return the public host key that the machine made at its first boot, if it has yet."""
        with self._lock:
            if identity in self._host_keys:
                return self._host_keys[identity]
        if own and os.geteuid() == 0:
            path = host_key_file(token)
            text = path.read_text() if path.exists() else ''
        elif own:
            text = process.run(
                Command(('cat', str(host_key_file(token))),
                        sudo=True), timeout=10.0, check=False).stdout
        else:
            log = engine.call('logs', identity, what='reading the host key', check=False).stdout
            text = _after(log, container_entry.HOST_KEY_MARK)
        key = ' '.join(text.split()[:2])
        if not key:
            return None
        with self._lock:
            self._host_keys[identity] = key
        return key

    def _complain(self, engine: Engine, identity: str) -> None:
        log = engine.call('logs', identity, what='reading its log', check=False).stdout
        reason = _after(log, container_entry.ERROR_MARK)
        if reason:
            raise ProviderError(f'container {identity} could not start: {reason}')


def _after(log: str, mark: str) -> str:
    found = [line[len(mark):] for line in log.splitlines() if line.startswith(mark)]
    return found[-1] if found else ''


def container_name(machine: str) -> str:
    """Return what the engine calls a machine."""
    return f'fogros2-{machine}'


def directory(token: str) -> Path:
    """
    Return where the root of the machine with this token lies.

    :raises MachineNotFound: the token isn't one of ours, so nothing is ever removed by it.
    """
    if not re.fullmatch(r'[A-Za-z0-9][A-Za-z0-9_-]{3,63}', token):
        raise MachineNotFound(f"'{token}' is no token of a container machine")
    return ROOTS / token


def host_key_file(token: str) -> Path:
    """Return where a machine with this computer's root leaves its public host key."""
    return directory(token) / 'root' / f'{container_entry.HOST_KEY}.pub'


def parse_id(machine_id: str) -> tuple[Engine, str, str]:
    """
    Return the engine, the container's id and the token that a machine's id carries.

    :raises MachineNotFound: it is no id of this provider's.
    """
    match = re.fullmatch(r'(podman|docker):([0-9a-f]{12}):([A-Za-z0-9_-]+)', machine_id)
    if not match:
        raise MachineNotFound(f"'{machine_id}' is no container machine")
    return container_engine.named(match[1]), match[2], match[3]


def labels_of(entry: Mapping[str, Any]) -> dict[str, str]:
    """Return the labels in what the engine knows of a container."""
    return dict(entry['Config']['Labels'] or {})


def address_of(entry: Mapping[str, Any]) -> str:
    """Return the container's first address, or ''."""
    networks = (entry.get('NetworkSettings') or {}).get('Networks') or {}
    return next((str(n['IPAddress']) for n in networks.values() if n.get('IPAddress')), '')


def timestamp(text: str) -> float:
    """Return an engine's time of creation in seconds since the epoch."""
    match = re.match(r'(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(\.\d{1,6})?\d*(Z|[+-]\d\d:\d\d)', text)
    if not match:
        return 0.0
    zone = '+00:00' if match[3] == 'Z' else match[3]
    fraction = (match[2] or '.0').ljust(7, '0')
    return datetime.datetime.fromisoformat(f'{match[1]}{fraction}{zone}').timestamp()


def mount_flag(mount: str) -> str:
    """Return the engine's form of a read-only mount."""
    source, _, target = mount.partition(':')
    return f'{source}:{target or source}:ro'


def common_flags(spec: MachineSpec, request: CreateRequest, options: Options) -> Iterator[str]:
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
        yield from ('--gpus', options.gpus)
    for device in options.devices:
        yield from ('--device', device)
    for port in options.ports:
        yield from ('-p', port)


def removal_hook(top: Path) -> str:
    """Return the hook by which the engine removes a machine's root when its container ends."""
    return json.dumps({
        'version': '1.0.0',
        'hook': {'path': '/bin/sh', 'args': [
            'sh', '-c', f'rm -rf -- {top}; rmdir -- {top.parent} 2>/dev/null; true']},
        'when': {'always': True},
        'stages': ['poststop'],
    })


def hook_flags(top: Path) -> Iterator[str]:
    """Yield the flags that make podman take the machine's own hook, and the system's."""
    for folder in ('/usr/share/containers/oci/hooks.d', '/etc/containers/oci/hooks.d'):
        if os.path.isdir(folder):
            yield from ('--hooks-dir', folder)
    yield from ('--hooks-dir', f'{top}/hooks')


def check_root() -> None:
    """
    Look whether this computer's own root can serve as an image.

    :raises PrerequisiteError: it can't be overlaid, or lacks what a machine needs.
    """
    process.require(
        ('sshd', 'ssh-keygen', 'sudo', 'rsync', 'tar'),
        package_of={'sshd': 'openssh-server', 'ssh-keygen': 'openssh-client'})
    kinds = Path('/proc/filesystems').read_text().split()
    if 'overlay' not in kinds and not os.path.isdir('/sys/module/overlay'):
        process.run(Command(('modprobe', 'overlay'), sudo=True), timeout=10.0, check=False)
        if 'overlay' not in Path('/proc/filesystems').read_text().split():
            raise PrerequisiteError("this computer's root can't be overlaid: no overlay support",
                                    "name an image with image='...'")
    kind = container_root.file_system(Path('/var/lib/containers/storage'))
    if kind.split('.')[0] in _NO_UPPER:
        raise PrerequisiteError(
            f"this computer's root can't be overlaid: /var/lib/containers is on {kind}",
            "put it on another file system, or name an image with image='...'")
