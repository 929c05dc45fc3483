# SPDX-License-Identifier: Apache-2.0
"""
Run machines on this computer: containers of podman or docker, each with an SSH server.

``engine`` calls podman and docker. ``root`` and ``debian_root`` make the root file system of a
machine without an image, ``hidden_files`` leaves out what only root may read, ``login_ids``
chooses the id of its user, ``entry`` makes its first process. ``packet_filter`` keeps machines
from this computer's ports. ``machine`` reads the reports of the engine, ``options`` parses the
options in launch files.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
import contextlib
from decimal import Decimal
import json
import os
from pathlib import Path
import re
import tempfile
from typing import Any, ClassVar, Optional

from fogros2 import process, untrusted
from fogros2.errors import (
    CommandError,
    DeadlineExceeded,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
    ProviderError,
    Unsupported,
)
from fogros2.model import Command, CreateRequest, Machine, MachineSpec, MachineState, Volume
from fogros2.provider import Attached, Capabilities, made_without, Provider, SETTLED, TAG_ROBOT
from fogros2.provider.container import debian_root, hidden_files, login_ids, packet_filter
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container import entry as container_entry
from fogros2.provider.container import machine as container_machine
from fogros2.provider.container import options as container_options
from fogros2.provider.container import root as container_root
from fogros2.provider.container.engine import Engine
from fogros2.provider.container.options import Options
from fogros2.provider.container.root import Archive
from fogros2.waiting import wait_until

#: File systems that cannot hold the writable layer of an overlay.
_NO_UPPER = ('overlay', 'nfs', 'nfs4', 'cifs', 'vfat', 'exfat', 'ntfs', '9p', 'virtiofs', 'fuse')

# One process does all steps, in its own session: a launch that is killed meanwhile leaves either
# nothing or a machine with its watchdog. After the seventh argument come the paths of layers, an
# empty word, and the engine's words. The input is a line with a label, and the root's archive.
#
# The machine has this computer's user ids, and root there makes any file. So no other account
# enters the folder, and no file in it gives rights or leads to a device, even where it is shown.
_CREATE = """\
top=$1 begin=$2 inside=$3 end=$4 look=$5 clean=$6 shown=$7
shift 7
umask 022
search= creating=
failed() {
    code=$?
    [ $code -eq 0 ] && return
    # it writes into the folder, and a hook of the engine waits for its result
    [ -n "$search" ] && kill "$search" 2>/dev/null && wait "$search" || :
    rm -f "$top/shown"
    # A launch that ends kills this group soon. A busy engine takes longer, and one that is killed
    # while it creates leaves a network.
    setsid sh -c 'tries=0
        while kill -0 "$4" 2>/dev/null && [ $tries -lt 600 ]; do
            sleep 0.1
            tries=$((tries + 1))
        done
        [ -s "$1/cid" ] && "$2" rm -f -v "$(cat "$1/cid")" >/dev/null 2>&1
        eval "$3"' sh "$top" "$engine" "$clean" "$creating" &
    wait
    exit $code
}
tries=0
# the end of the last machine may remove the outer folder
until reason=$({ install -d -m 700 "${top%/*}" && mkdir -m 700 "$top"; } 2>&1); do
    # another attempt with this token, or one that was interrupted
    [ ! -e "$top" ] || exit 17  # _TOKEN_USED
    [ $((tries += 1)) -lt 10 ] || { echo "$reason" >&2; exit 1; }
done
trap failed EXIT
# dash runs no EXIT trap for a signal, and a signal interrupts 'wait' alone
trap 'exit 143' HUP INT TERM
mount --bind -o nosuid,nodev "$top" "$top"
mkdir "$top/root" "$top/hooks"
IFS= read -r label
printf '%s\n' "$label" >"$top/labels"
printf %s "$begin" >"$top/hooks/begin.json"
printf %s "$inside" >"$top/hooks/inside.json"
printf %s "$end" >"$top/hooks/end.json"
while [ -n "$1" ]; do mkdir -p "$top/layers$1/upper" "$top/layers$1/work"; shift; done
shift
engine=$1
printf '%s' "$shown" >"$top/shown"
python3 -IS -c "$look" "$top" </dev/null >/dev/null 2>&1 &
search=$!
tar -xpf - --numeric-owner -C "$top/root"
setsid "$@" &
creating=$!
wait $creating
"""

# Podman forgets the folder of a container's hooks when the container has started.
_START = """\
top=$1
install -d -m 700 "${top%/*}" "$top" "$top/hooks"
[ ! -e "$top/root" ] || mountpoint -q "$top" || mount --bind -o nosuid,nodev "$top" "$top"
printf %s "$2" >"$top/hooks/begin.json"
printf %s "$3" >"$top/hooks/inside.json"
printf %s "$4" >"$top/hooks/end.json"
rm -f "$top/hidden"
if [ -e "$top/shown" ]; then python3 -IS -c "$5" "$top" </dev/null >/dev/null 2>&1 & fi
search=$!
shift 5
setsid "$@" || { code=$?; kill "$search" 2>/dev/null; exit $code; }
"""

# The machine's login user has any number; the first process gives it the folder 'own'. The names
# stay root's. Only machines of one user of this computer meet: no other user enters the outermost
# folder. The end of the last machine removes the outer folders.
_SHARE = """\
umask 077
top=$1
shift
tries=0
until reason=$({ mkdir -p "$top/own" && chmod 1777 "$top/own" &&
        chmod 755 "$top" "${top%/*}"; } 2>&1); do
    [ $((tries += 1)) -lt 10 ] || { echo "$reason" >&2; exit 1; }
    sleep 0.1
done
umask 022
printf '%s\\n' "$@" >"$top/topics"
"""

_UNSHARE = 'rm -rf "$1"; rmdir "${1%/*}" "${1%/*/*}" 2>/dev/null'

#: Maximum size of the part of a machine's log that is read, in bytes.
_LOG_BYTES = 1 << 20
_READ_LOG = f'"$@" 2>/dev/null | head -c {_LOG_BYTES}'

#: Exit statuses of a regular end, SIGKILL and SIGTERM.
_GOOD_ENDS = (0, 137, 143)
#: Exit status of ``_CREATE`` for a token that was used before.
_TOKEN_USED = 17

_DESTROY = """\
identity=$1 clean=$2
shift 2
"$@" rm -f -v -t 0 "$identity" >/dev/null || "$@" rm -f -v "$identity" >/dev/null
code=$?
sh -c "$clean"
exit $code
"""


class ContainerProvider(Provider):
    """Containers of podman or docker on this computer."""

    name: ClassVar[str] = 'container'
    #: Containers only on request: they need SYS_ADMIN, which weakens the machine's isolation.
    capabilities: ClassVar[Capabilities] = Capabilities(
        containers=False, stop=True, keeps_volumes=True,
        agent_directory=f'/{container_entry.AGENT_DIRECTORY}',
        agent_program=f'/{container_entry.FOLDER}/agent.py',
        share_folders=container_options.SHARE_FOLDERS)
    poll_interval: ClassVar[float] = 0.1

    def __init__(self) -> None:
        self._host_keys: dict[str, str] = {}

    @classmethod
    def configured(cls) -> bool:
        """Return whether an engine is installed."""
        return any(container_engine.installed())

    def check_here(self, spec: MachineSpec) -> None:
        """Check that the engine, TUN and the programs for a machine without an image exist."""
        options = Options.parse(spec.options)
        container_engine.select(options.engine, options.image)
        if not os.path.exists('/dev/net/tun'):
            raise PrerequisiteError('there is no /dev/net/tun on this computer',
                                    'sudo modprobe tun')
        if not options.image:
            check_programs(isolated=options.isolated)

    def check(self, spec: MachineSpec) -> None:
        """Check the engine, the rights, TUN, and what a machine without an image needs."""
        self.check_here(spec)
        options = Options.parse(spec.options)
        engine = container_engine.select(options.engine, options.image)
        trouble = process.sudo_trouble()  # the packet filter needs it with docker's group, too
        if trouble is not None:
            raise PrerequisiteError(
                f'a container machine needs root on this computer, and {trouble[0]}', trouble[1])
        container_engine.answers(engine)
        if options.image:
            container_engine.check_architecture(engine, options.image)
        else:
            check_root()
            for path in () if options.isolated else container_root.environment_mounts(
                    *spec.workspaces):
                if options.user != 'root' and not os.stat(path).st_mode & 0o004:
                    raise PrerequisiteError(
                        f"the user of a container machine can't read {path}",
                        f'chmod -R o+rX {path}')

    def architecture(self, spec: MachineSpec) -> str:
        """Return the image's architecture; the engine downloads images for this computer's."""
        options = Options.parse(spec.options)
        if not options.image:
            return os.uname().machine
        engine = container_engine.select(options.engine, options.image)
        return container_engine.architecture(engine, options.image) or os.uname().machine

    def shared_folders(self, spec: MachineSpec) -> Sequence[str]:
        """Return the folders of the system and of ROS 2, which replace an image."""
        options = Options.parse(spec.options)
        return () if options.image or options.isolated else (
            *container_root.system_mounts(), *container_root.environment_mounts(*spec.workspaces))

    def cost_per_hour(self, spec: MachineSpec) -> Decimal:
        """Return 0: a machine on this computer costs nothing."""
        return Decimal(0)

    def has_own_packages(self, spec: MachineSpec) -> bool:
        """Return whether the machine starts from a container image."""
        return bool(spec.options.get('image'))

    def check_containers(self, spec: MachineSpec) -> None:
        """Check that the machine is created with the rights to run containers."""
        if not Options.parse(spec.options).containers:
            raise Unsupported(f"'{spec.name}' was created without the rights for containers",
                              'set containers=True where the machine is described')

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Create and start the container; return when the engine has started it."""
        options = Options.parse(spec.options)
        engine = container_engine.select(options.engine, options.image)
        create = self._create_from_image if options.image else self._create_from_root
        for name in request.with_volumes:
            _check_free(engine, name, container_machine.container_name(spec.name, request.tags))
        with _sharing(request):
            try:
                identity = container_engine.tried(
                    engine, lambda way: create(way, spec, request, options))
            except ProviderError as error:
                identity = self._existing(engine, spec.name, request, error)
        return container_machine.machine_id(engine, identity, request.token)

    def _existing(
        self, engine: Engine, name: str, request: CreateRequest, error: ProviderError,
    ) -> str:
        """Return the container that an earlier attempt with this token created, or raise."""
        reports = engine.inspect([container_machine.container_name(name, request.tags)])
        if not reports:
            raise error
        labels = container_machine.labels_of(reports[0])
        if labels.get(container_machine.ATTEMPT) != request.token:
            owner = labels.get(TAG_ROBOT)
            own = owner == request.tags.get(TAG_ROBOT)
            whose = f' of the robot {owner}' if owner and not own else ''
            raise NameTaken(
                f"there is a container machine '{name}'{whose} already",
                f'ros2 fog delete {name}' if own else 'give the machine another name=') from error
        return str(reports[0]['Id'])

    def _create_from_root(
        self, engine: Engine, spec: MachineSpec, request: CreateRequest, options: Options,
    ) -> str:
        top = container_machine.directory(request.token)
        base = str(debian_root.root(cancel=self.cancel)) if options.isolated else ''
        system = container_root.system_mounts(base)
        kept = spec.on_exit == 'stop'
        words = [*container_options.common_flags(engine, spec, request, options)]
        for path in system:
            # Podman deletes its own layer when the container ends; a stopped machine keeps it.
            upper = f',upperdir={top}/layers{path}/upper,workdir={top}/layers{path}/work'
            words += ['-v', f"{base}{path}:{path}:O{upper if kept else ''}"]
        environment = () if base else container_root.environment_mounts(*spec.workspaces)
        for mount in environment:
            words += ['-v', f'{mount}:{mount}:ro']
        # nodes that run as root may need files of an environment that only its owner may read
        shown = () if base else system if options.user == 'root' else (
            *system, *filter(os.path.isdir, environment))
        number = login_ids.login_id(request.token)
        archive = _entry(request, options, number)
        container_root.accounts(archive, options.user, number, Path(f'{base}/etc'))
        if base:
            archive.file('etc/apt/sources.list', ''.join(
                f'{line}\n' for line in debian_root.release().sources).encode())
            archive.file('etc/apt/apt.conf.d/90fogros2', debian_root.connection().encode())
        command = Command(
            ('sh', '-ec', _CREATE, 'sh', str(top), *hooks(top, kept=kept),
             hidden_files.source(), clean(top),
             ''.join(f'{path}\n' for path in shown),
             *(system if kept else ()), '', engine.name, *engine.flags, *hook_flags(top),
             'run', '-d', '--cidfile', f'{top}/cid', '--label-file', f'{top}/labels', *words,
             '--rootfs', f'{top}/root', '/bin/sh', f'/{container_entry.FOLDER}/entry.sh'),
            sudo=engine.sudo, what=f"creating container machine '{spec.name}'",
            input=container_machine.token_label(request.token).encode()
            + container_root.skeleton(base) + archive.data())
        try:
            return process.run(command, timeout=120.0).stdout.split()[-1]
        except CommandError as error:
            if error.result.returncode != _TOKEN_USED:
                raise container_engine.translate(error) from error
            raise ProviderError(
                f'an interrupted attempt to create {spec.name} left {top}',
                f'sudo umount -l {top}; sudo rm -rf {top}') from error

    def _create_from_image(
        self, engine: Engine, spec: MachineSpec, request: CreateRequest, options: Options,
    ) -> str:
        what = f"creating container machine '{spec.name}' from {options.image}"
        identity = engine.call(
            'create', *container_options.common_flags(engine, spec, request, options),
            '--label-file', '/dev/stdin', '--user', '0:0', '--entrypoint', '/bin/sh',
            options.image, f'/{container_entry.FOLDER}/entry.sh', what=what, timeout=1800.0,
            data=container_machine.token_label(request.token).encode(),
            variables=process.proxies(), cancel=self.cancel).stdout.split()[-1]
        try:
            # podman keeps what it has copied in its folder for temporary files
            with tempfile.TemporaryDirectory() as aside:
                engine.call('cp', '-', f'{identity}:/', what=what, variables=(f'TMPDIR={aside}',),
                            data=_entry(request, options,
                                        login_ids.login_id(request.token)).data())
            _start(engine, identity, request.token, kept=spec.on_exit == 'stop', what=what)
        except BaseException:
            with contextlib.suppress(ProviderError, DeadlineExceeded):
                self.destroy(container_machine.machine_id(engine, identity, request.token))
            raise
        return identity

    def describe(self, machine_id: str) -> Machine:
        """Return the state of a container, from the engine."""
        engine, identity, report = _inspected(machine_id)
        state = container_machine.state_of(report)
        if state is MachineState.STOPPED:
            self._check_exit(engine, report)
        key = None
        if state is MachineState.RUNNING:
            # The first boot creates the key in 20 ms; another call of the engine takes longer.
            with contextlib.suppress(DeadlineExceeded):
                key = wait_until(lambda: self._host_key(engine, report), timeout=0.15,
                                 interval=0.004, longest=0.02, what='the host key')
        return container_machine.machine_of(engine, report, key)

    def find(self, tags: Mapping[str, str]) -> Iterator[Machine]:
        """Yield the containers of both engines that have all of ``tags`` as labels."""
        for engine, entry in self._containers(tags):
            running = container_machine.state_of(entry) is MachineState.RUNNING
            yield container_machine.machine_of(
                engine, entry, self._host_key(engine, entry) if running else None)

    def _containers(self, tags: Mapping[str, str]) -> Iterator[tuple[Engine, Mapping[str, Any]]]:
        """Yield the engines' reports of the containers that have all of ``tags`` as labels."""
        filters = [f'--filter=label={container_machine.ATTEMPT}',
                   *(f'--filter=label={key}={value}' for key, value in tags.items())]
        engines = list(container_engine.installed())
        if not engines:
            raise PrerequisiteError('neither podman nor docker found on this computer',
                                    'sudo apt-get install podman')
        for engine in engines:
            result = engine.call('ps', '-aq', *filters, what='listing containers', check=False)
            if result.returncode != 0 and not container_engine.stopped(result.stderr):
                raise ProviderError(
                    f'{engine.name} lists no containers: '
                    f'{process.last_error(result.stderr)}',
                    container_engine.sudo_hint(result.stderr))
            # Without docker's service, its socket may still exist; it has no containers.
            listed = result.stdout.split()
            if listed:
                yield from ((engine, entry) for entry in engine.inspect(listed))

    def may_create(self, token: str, age: float) -> bool:
        """Return whether an engine still works at a request: it may outlive its launch."""
        return _in_use(container_machine.directory(token))

    def tidy(self, dead: Collection[str] = ()) -> list[str]:
        """Remove the folders of machines without a container, such as of a killed creation."""
        roots = container_machine.ROOTS
        if not roots.is_dir() and not container_machine.SHARED.is_dir():
            return []
        listed = process.run(
            Command(('find', str(roots), '-mindepth', '1', '-maxdepth', '1', '-mmin',
                     f'+{SETTLED / 60:g}'), sudo=True), timeout=30.0, check=False).stdout
        ended = {*map(container_machine.directory, dead), *(
            Path(line) for line in listed.splitlines()
            if re.fullmatch('.*/[0-9a-f]{16}', line))}
        # before the search for containers: a creation that ends meanwhile leaves one
        ended = {top for top in ended if not _in_use(top)}
        if ended:
            ended -= {container_machine.directory(
                container_machine.labels_of(entry)[container_machine.ATTEMPT])
                for _, entry in self._containers({})}
        for top in ended:
            process.run(Command(('sh', '-c', clean(top)), sudo=True, what=f'remove {top}'),
                        timeout=60.0)
        return [f'the folder {top}' for top in sorted(ended)]

    def destroy(self, machine_id: str) -> None:
        """Remove a container and its root; return when both are removed."""
        engine, identity, token = container_machine.parse_id(machine_id)
        cleaning = clean(container_machine.directory(token))
        result = process.run(
            Command(('sh', '-c', _DESTROY, 'sh', identity, cleaning if engine.sudo else '',
                     *engine.argv()),
                    sudo=engine.sudo, what=f'removing container {identity}'),
            timeout=60.0, check=False)
        self._host_keys.pop(identity, None)
        if not engine.sudo:
            # a user in docker's group may remove the container, but not the rest
            try:
                process.run(Command(('sh', '-c', cleaning), sudo=True,
                                    what=f'removing the packet filter of container {identity}'),
                            timeout=60.0)
            except CommandError as error:
                raise container_engine.translate(error) from error
        if result.returncode == 0:
            return
        if sudo := container_engine.sudo_hint(result.stderr):
            raise ProviderError(f'container {identity} was not removed', sudo)
        # The engine may be removing it already.
        wait_until(lambda: not engine.inspect([identity]), timeout=20.0,
                   what=f'container {identity} to be removed',
                   hint=process.last_error(result.stderr))

    def stop(self, machine_id: str) -> None:
        """Stop a container that was created with ``on_exit='stop'``; its disk stays."""
        engine, identity, report = _inspected(machine_id)
        if container_machine.ENDS_STOPPED not in container_machine.labels_of(report):
            raise Unsupported('a container made to be deleted at its end can not be stopped',
                              "create it with on_exit='stop'")
        engine.call('stop', '-t', '3', identity, what=f'stopping container {identity}')

    def start(self, machine_id: str) -> None:
        """Start a stopped container again."""
        engine, identity, report = _inspected(machine_id)
        token = container_machine.labels_of(report)[container_machine.ATTEMPT]
        _start(engine, identity, token, kept=True, what=f'starting container {identity}')

    def dialled_at(
        self, machine: Machine, port: int, host: Optional[str] = None,
    ) -> tuple[str, int]:
        """Publish the machine's VPN port at the same port of this computer."""
        token = container_machine.parse_id(machine.id)[2]
        name = filter_name(container_machine.directory(token))
        process.run(
            Command.script(packet_filter.publish(name, port, machine.vpn_host), sudo=True,
                           what=f"publish the VPN port of '{machine.name}'"), timeout=10.0)
        return host or '', port

    def volumes(self, hosts: Sequence[str] = ()) -> Iterator[Volume]:
        """Yield the engines' own volumes with FogROS2's names."""
        prefix = container_machine.volume_name('')
        for engine in container_engine.installed():
            listed = engine.call('volume', 'ls', '-q', f'--filter=name={prefix}',
                                 what='listing volumes', check=False).stdout.split()
            for name in listed:
                if name.startswith(prefix):
                    yield Volume(f'{engine.name}:{name}', name[len(prefix):], self.name,
                                 engine.name, user=', '.join(map(
                                     container_machine.name_of, _users_of(engine, name))))

    def attach(self, machine_id: str, name: str, size_gb: int) -> Attached:
        """Return nothing: the engine has mounted the volume, whose size has no limit."""
        engine, _, report = _inspected(machine_id)
        labels = container_machine.labels_of(report)
        machine = labels[container_machine.MACHINE]
        # of two launches at once, each may have created one
        _check_free(engine, name, container_machine.container_name(machine, labels))
        if not _users_of(engine, container_machine.volume_name(name)):
            raise made_without(machine, name)
        return Attached()

    def detach(self, machine_id: str, name: str) -> None:
        """Do nothing: the machine's end frees the volume."""

    def delete_volume(self, volume_id: str) -> None:
        """Remove a volume of an engine, which refuses if any container uses it."""
        kind, _, name = volume_id.partition(':')
        engine, prefix = container_engine.named(kind), container_machine.volume_name('')
        if not name.startswith(prefix):
            raise MachineNotFound(f"'{volume_id}' is no volume of a container machine")
        _check_free(engine, name[len(prefix):])
        if name in engine.call('volume', 'ls', '-q', what='listing volumes').stdout.split():
            engine.call('volume', 'rm', name, what=f'removing the volume {name}', timeout=600.0)

    def _host_key(self, engine: Engine, entry: Mapping[str, Any]) -> Optional[str]:
        """Return the public host key that a machine created at its first boot, None before."""
        identity = str(entry['Id'])[:12]
        if identity in self._host_keys:
            return self._host_keys[identity]
        path = container_machine.host_key_file(
            container_machine.labels_of(entry)[container_machine.ATTEMPT])
        if entry['Config'].get('Image'):
            # the machine writes its log, so only its beginning is read
            log = process.run(
                Command(('sh', '-c', _READ_LOG, 'sh', *engine.argv('logs', identity)),
                        sudo=engine.sudo, what='reading the host key'),
                timeout=60.0, check=False).stdout
            text = _after(log, container_entry.HOST_KEY_MARK)
        else:
            # the machine can replace the file by a link to a file of this computer, or by a pipe
            text = process.run(Command(
                ('dd', f'if={path}', 'iflag=nofollow,nonblock', 'bs=4096', 'count=1'), sudo=True),
                timeout=10.0, check=False).stdout
        key = ' '.join(text.split()[:2])
        if not untrusted.HOST_KEY.fullmatch(key):
            return None
        self._host_keys[identity] = key
        return key

    def _check_exit(self, engine: Engine, entry: Mapping[str, Any]) -> None:
        """
        Check that a container that ended did so regularly; images may lack what it needs.

        :raises ProviderError: it ended by an error; with the container's last message.
        """
        if int(entry['State']['ExitCode']) in _GOOD_ENDS:
            return
        identity = str(entry['Id'])[:12]
        log = engine.call('logs', '--tail', '100', identity, what='reading its log', check=False,
                          kept=_LOG_BYTES)
        reason = _after(log.stdout, container_entry.ERROR_MARK) \
            or process.last_error(f'{log.stderr}\n{log.stdout}')
        raise ProviderError(f'container {identity} could not start: {reason}',
                            'it needs sshd, sudo, rsync and python3, or apt-get and a network')


def _in_use(top: Path) -> bool:
    """Return whether a program works at a machine with this folder."""
    for path in Path('/proc').glob('[0-9]*/cmdline'):
        with contextlib.suppress(OSError):
            if top.name.encode() in path.read_bytes():
                return True
    return False


def _users_of(engine: Engine, volume: str) -> list[dict[str, Any]]:
    """Return the engine's reports of the containers that have a volume."""
    listed = engine.call('ps', '-aq', f'--filter=volume={volume}',
                         what='looking at a volume').stdout.split()
    return engine.inspect(listed) if listed else []


def _check_free(engine: Engine, name: str, container: str = '') -> None:
    """
    Check that no other container has a volume.

    :raises NameTaken: one has.
    """
    for user in _users_of(engine, container_machine.volume_name(name)):
        if str(user['Name']).lstrip('/') != container:
            machine, labels = container_machine.name_of(user), container_machine.labels_of(user)
            robot = labels.get(TAG_ROBOT) if container_machine.HOSTED in labels else None
            raise NameTaken(
                f"the machine '{machine}'{f' of the robot {robot}' if robot else ''} has the "
                f"volume '{name}'",
                f"end its launch, or{' there' if robot else ''}: ros2 fog delete {machine}")


@contextlib.contextmanager
def _sharing(request: CreateRequest) -> Iterator[None]:
    """Make the folder that other machines here see, if it needs one; remove it after an error."""
    folder = str(container_machine.share_folder(request.token))
    with contextlib.ExitStack() as failed:
        if request.common:
            failed.callback(process.run, Command(('sh', '-c', _UNSHARE, 'sh', folder), sudo=True),
                            timeout=10.0, check=False)
            process.run(Command(('sh', '-ec', _SHARE, 'sh', folder, *request.common), sudo=True,
                                what='make the folder that machines share'), timeout=10.0)
        yield
        failed.pop_all()


def _inspected(machine_id: str) -> tuple[Engine, str, dict[str, Any]]:
    """
    Return a machine's engine, its container's id, and what the engine reports of it.

    :raises MachineNotFound: there is no such container.
    """
    engine, identity, _ = container_machine.parse_id(machine_id)
    reports = engine.inspect([identity])
    if not reports:
        raise MachineNotFound(f'container {identity} does not exist any more')
    return engine, identity, reports[0]


def _start(engine: Engine, identity: str, token: str, *, kept: bool, what: str) -> None:
    """Start a container with its packet filter; podman sets the filter before the start."""
    top = container_machine.directory(token)
    if engine.name == 'podman':
        words = ('-ec', _START, 'sh', str(top), *hooks(top, kept=kept),
                 hidden_files.source(), engine.name, *engine.flags, *hook_flags(top), 'start',
                 identity)
        state = {}
    else:
        engine.call('start', identity, what=what)
        words = ('-c', packet_filter.SET, 'sh', filter_name(top))
        state = {'pid': engine.inspect([identity])[0]['State']['Pid']}
    try:
        process.run(Command(('sh', *words), sudo=True, what=what,
                            input=json.dumps(state).encode()), timeout=60.0)
    except CommandError as error:
        raise container_engine.translate(error) from error


def _entry(request: CreateRequest, options: Options, number: int) -> Archive:
    return container_entry.archive(
        user=options.user, number=number, authorized_key=request.authorized_key,
        agent_config=request.agent_config, nested=options.containers)


def _after(log: str, mark: str) -> str:
    lines = [line[len(mark):] for line in log.splitlines() if line.startswith(mark)]
    return lines[-1] if lines else ''


def filter_name(top: Path) -> str:
    """Return the name of a machine's packet filter."""
    return f'fogros2-{top.name}'


def clean(top: Path) -> str:
    """Return shell text that removes a machine's packet filter, root and shared folder."""
    return (f'{packet_filter.unset(filter_name(top))}; umount -l {top} 2>/dev/null; '
            f'rm -rf -- {top} {container_machine.SHARED}/*/{top.name}; rmdir -- {top.parent} '
            f'{container_machine.SHARED}/* {container_machine.SHARED} 2>/dev/null; true')


def hooks(top: Path, *, kept: bool) -> Iterator[str]:
    """
    Yield the hooks by which podman sets a machine's packet filter and hides files, and cleans up
    at its end.

    :param kept: only the filter ends with the container.
    """
    end = packet_filter.unset(filter_name(top)) if kept else clean(top)
    for stage, words in (('createRuntime', (packet_filter.SET, 'sh', filter_name(top))),
                         ('createContainer', (hidden_files.HIDE, 'sh', str(top))),
                         ('poststop', (end,))):
        yield json.dumps({
            'version': '1.0.0', 'when': {'always': True}, 'stages': [stage],
            'hook': {'path': '/bin/sh', 'args': ['sh', '-c', *words]}})


def hook_flags(top: Path) -> Iterator[str]:
    """Yield podman's flags for the machine's own hook, and for the system's."""
    for folder in ('/usr/share/containers/oci/hooks.d', '/etc/containers/oci/hooks.d'):
        if os.path.isdir(folder):
            yield from ('--hooks-dir', folder)
    yield from ('--hooks-dir', f'{top}/hooks')


def check_programs(*, isolated: bool = False) -> None:
    """
    Check that the programs exist that a machine without an image needs.

    :param isolated: with the root of a new system.
    :raises PrerequisiteError: one is missing.
    """
    if isolated:
        debian_root.check_programs()
    else:
        process.require(
            ('sshd', 'ssh-keygen', 'sudo', 'rsync', 'tar'),
            package_of={'sshd': 'openssh-server', 'ssh-keygen': 'openssh-client'})


def check_root() -> None:
    """
    Check that a root of this computer can be overlaid, and so replace an image.

    :raises PrerequisiteError: it cannot be overlaid.
    """
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
