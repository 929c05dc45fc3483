# SPDX-License-Identifier: Apache-2.0
"""
Container machines on another computer, the host of a fleet: one for each robot.

The host has an SSH server and a container engine, and keeps nothing running for FogROS2. The
program ``served`` creates the container there, whose agent then ends it without the robot. The
robot reaches the container at ports that the engine publishes on the host.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
from decimal import Decimal
import functools
import gzip
import hashlib
from pathlib import Path
import re
from typing import Any, ClassVar, Optional, TypedDict, TypeVar

from fogros2 import errors, model, plugin_system, untrusted
from fogros2.errors import FogError, MachineNotFound, ProviderError, Unsupported
from fogros2.model import (
    Command,
    CreateRequest,
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
    Volume,
)
from fogros2.provider import Attached, Capabilities, Provider, TAG_NAME
from fogros2.provider.container import ContainerProvider
from fogros2.provider.container.entry import END_COMMAND
from fogros2.provider.container.machine import HOSTED, ID
from fogros2.provider.container.options import Options
from fogros2.provider.container.root import Archive
from fogros2.provider.options import parsed
from fogros2.shell import connect, Shell
from fogros2.shell.command_line import checked
from fogros2.store import robot_id, Store

T = TypeVar('T')
_SCHEME = 'hosted:'
#: The container provider's id of a volume, which ends with its name.
_VOLUME = re.compile('(?:podman|docker):fogros2-volume-([a-z0-9-]+)')
#: Seconds for one call on the host; a creation may download an image.
_TIMEOUT, _CREATE_TIMEOUT = 90.0, 1900.0
#: Errors of the host that stay what they are; all others are a ProviderError.
_KINDS = ('ConfigurationError', 'PrerequisiteError', 'MachineNotFound', 'NameTaken', 'Unsupported')
#: The modules that the host runs, below the folder of the packages.
_SENT = (*(f'fogros2/{folder}*.py' for folder in (
    '', 'agent/', 'agent_client/', 'shell/', 'provider/', 'provider/container/')),
    'fogros2_features/__init__.py', 'fogros2_features/hosts/__init__.py',
    'fogros2_features/hosts/served.py')
_FOLDER = 'folder=${XDG_CACHE_HOME:-$HOME/.cache}/fogros2/host-$1\n'
# The machines show the host's ROS 2, if it has one. Exit status 75: the host lacks the modules.
_SERVE = _FOLDER + """\
cd "$folder" 2>/dev/null || exit 75
for setup in /opt/ros/*/setup.sh; do [ ! -e "$setup" ] || . "$setup"; done
exec python3 -m fogros2_features.hosts.served
"""
_KEEP = _FOLDER + """\
mkdir -p "${folder%/*}"
aside=$(mktemp -d "$folder.XXXXXX")
trap 'rm -rf -- "$aside"' EXIT
trap 'exit 143' HUP INT TERM
tar -xzf - --no-same-owner -C "$aside"
mv -T "$aside" "$folder" 2>/dev/null || [ -d "$folder" ]
"""


class _Answer(TypedDict, total=False):
    """The line that ``served`` prints: a result, or an error."""

    result: Any
    error: str
    message: str
    hint: str


class _Endpoint(TypedDict):
    port: int
    user: str
    host_key: str


class _Machine(TypedDict):
    """A machine as its host reports it."""

    id: str
    state: str
    created: float
    endpoint: Optional[_Endpoint]
    vpn_host: str
    vpn_port: int
    image: str
    tags: dict[str, str]


class _Volume(TypedDict):
    id: str
    user: str


@functools.lru_cache(maxsize=1)
def program() -> tuple[bytes, str]:
    """Return the archive of the modules that a host runs, and its hash."""
    archive, top = Archive(), Path(model.__file__).parents[1]
    for path in sorted(path for pattern in _SENT for path in top.glob(pattern)):
        archive.file(str(path.relative_to(top)), path.read_bytes())
    data = gzip.compress(archive.data(), mtime=0)
    return data, hashlib.sha256(data).hexdigest()[:16]


def result_of(text: str, name: str) -> Any:
    """
    Return the result in the output of ``served``.

    :param name: the host's name, for messages.
    :raises FogError: the error of the call on the host.
    """
    try:
        answer: _Answer = untrusted.parsed(text.splitlines()[-1], _Answer)
        if 'error' not in answer:
            return answer['result']
        kind = getattr(errors, answer['error']) if answer['error'] in _KINDS else ProviderError
        error: FogError = kind(answer['message'], answer['hint'])
    except (untrusted.InvalidMessage, LookupError) as invalid:
        error = ProviderError(f"the host '{name}' sent no answer, but {text[-200:]!r}",
                              'its login must print nothing after a command')
        error.refused = False
        raise error from invalid
    raise error


class HostedProvider(Provider):
    """Containers of podman or docker on a computer with an SSH server."""

    name: ClassVar[str] = 'hosted'
    capabilities: ClassVar[Capabilities] = dataclasses.replace(
        ContainerProvider.capabilities, ports=False)

    def __init__(self) -> None:
        self._ssh: Provider = plugin_system.load('fogros2.provider', 'ssh')()
        #: By their ids at the provider of SSH machines: hosts, with their machines there.
        self._hosts: dict[str, tuple[Machine, Shell]] = {}
        self._asked: list[Mapping[str, Any]] = []

    def cost_per_hour(self, spec: MachineSpec) -> Decimal:
        """Return 0: the host exists already."""
        return Decimal(0)

    # -- the host -------------------------------------------------------------------------------

    def _find_host(self, on: Mapping[str, Any]) -> str:
        """Return the id of the host that an option ``on`` describes."""
        return self._ssh.create(MachineSpec(on['host'], 'ssh', on), CreateRequest('', '', {}, 0))

    def _host(self, host: str) -> tuple[Machine, Shell]:
        if host not in self._hosts:
            machine = self._ssh.describe(host)
            if machine.endpoint is None:
                raise errors.ConnectError(f"the host '{machine.name}' does not answer",
                                          'is it on, and reachable from this robot?')
            self._hosts[host] = machine, connect(machine.endpoint, name=machine.name)
        return self._hosts[host]

    def _call(self, host: str, call: str, timeout: float = _TIMEOUT, **given: Any) -> Any:
        """
        Call a method of the container provider on a host.

        :raises FogError: the method's error, or the host cannot be reached.
        """
        machine, shell = self._host(host)
        data, key = program()
        ask = Command(('sh', '-c', _SERVE, 'sh', key), what=f'{call} a container machine',
                      input=model.to_json({'call': call, 'given': given}).encode())
        run = functools.partial(shell.run, ask, check=False, timeout=timeout,
                                cancel=self.cancel if call == 'create' else None)
        done = run()
        if done.returncode == 75:
            shell.run(Command(('sh', '-ec', _KEEP, 'sh', key), input=data,
                              what='send the program for container machines'), timeout=_TIMEOUT)
            done = run()
        return result_of(checked(ask, done, f"'{machine.name}'").stdout, machine.name)

    def _call_of(self, machine_id: str, call: str) -> Any:
        host, identity = _parse(machine_id)
        return self._call(host, call, id=identity)

    # -- before a machine exists ----------------------------------------------------------------

    def check(self, spec: MachineSpec) -> None:
        """Check the options without a connection; the host checks their values."""
        self._ssh.check(MachineSpec(spec.name, 'ssh', self._options(spec)[0]))

    def check_here(self, spec: MachineSpec) -> None:
        """Check that the host answers."""
        self.check(spec)
        self._find_host(self._options(spec)[0])

    def _options(self, spec: MachineSpec) -> tuple[Mapping[str, Any], dict[str, Any]]:
        """
        Return the options of the host, and of the container.

        :raises ConfigurationError: one is unknown, or has another type.
        """
        options = dict(spec.options)
        self._asked.append(options.pop('on', {}))
        parsed(Options, options, 'a container machine')
        return self._asked[-1], options

    def check_containers(self, spec: MachineSpec) -> None:
        """Check that the machine is created with the rights to run containers."""
        ContainerProvider().check_containers(
            dataclasses.replace(spec, options=self._options(spec)[1]))

    def has_own_packages(self, spec: MachineSpec) -> bool:
        """Return whether the machine starts from a container image."""
        return bool(spec.options.get('image'))

    # -- a machine's life -----------------------------------------------------------------------

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Create and start the container on the host."""
        on, options = self._options(spec)
        host = self._find_host(on)
        options['ports'] = [*(options.get('ports') or ()), '22', f'{request.vpn_port}/udp']
        robot = f'-{hashlib.sha256(robot_id().encode()).hexdigest()[:8]}'
        try:
            identity = self._call(
                host, 'create', _CREATE_TIMEOUT,
                spec={'name': spec.name, 'provider': ContainerProvider.name, 'options': options,
                      'on_exit': spec.on_exit},
                request=dataclasses.replace(request, tags={**request.tags, HOSTED: robot}))
        except errors.ShellError as error:
            error.refused = False  # the host may go on without the connection
            raise
        with self._reading(host):
            return f'{_SCHEME}{untrusted.matched(ID, identity)}@{host}'

    def describe(self, machine_id: str) -> Machine:
        """Return the state of a container, from the host."""
        return self._machine(_parse(machine_id)[0], self._call_of(machine_id, 'describe'))

    @contextlib.contextmanager
    def _reading(self, host: str) -> Iterator[None]:
        """Turn the error of a wrong report into one that names the host."""
        try:
            yield
        except ValueError as error:
            raise ProviderError(f"the host '{self._host(host)[0].name}' reports a machine "
                                f'wrongly: {error}', 'the host may be hijacked') from error

    def _machine(self, host: str, report: Any) -> Machine:
        """Return a machine as the robot sees it, from the report of its host."""
        outside, _ = self._host(host)
        assert outside.endpoint is not None
        with self._reading(host):
            untrusted.checked(report, _Machine)
            found: _Machine = report
            login = found['endpoint']
            return Machine(
                f"{_SCHEME}{untrusted.matched(ID, found['id'])}@{host}",
                found['tags'].get(TAG_NAME, ''), self.name, MachineState(found['state']),
                found['created'], login and Endpoint(
                    'ssh', outside.endpoint.host, untrusted.port(login['port']),
                    untrusted.matched(untrusted.NAME, login['user']),
                    untrusted.matched(untrusted.HOST_KEY, login['host_key']),
                    alias=outside.endpoint.alias),
                # the host's packet filter admits no machine to the host's ports
                outside.vpn_host, untrusted.port(found['vpn_port']), private_network=host,
                private_ip=untrusted.address(found['vpn_host']), region=outside.name,
                image=found['image'], tags=found['tags'], end_command=END_COMMAND)

    def find(self, tags: Mapping[str, str]) -> Iterator[Machine]:
        """
        Yield the robots' containers on the hosts that this robot's records name.

        :raises Unsupported: it knows no host.
        :raises FogError: a host does not answer, after the machines of all others.
        """
        yield from (
            machine for machine in self._everywhere(
                self._known(), 'find', self._machine, tags=tags) if HOSTED in machine.tags)

    def tidy(self, dead: Collection[str] = ()) -> list[str]:
        """Remove what is left of machines on the hosts that this robot's records name."""
        def read(host: str, words: Any) -> str:
            with self._reading(host):
                untrusted.checked(words, str)
            return f'{words} on {self._host(host)[0].name}'

        with contextlib.suppress(Unsupported):
            return list(self._everywhere(self._known(), 'tidy', read, dead=list(dead)))
        return []

    def _known(self) -> list[Mapping[str, Any]]:
        """
        Return the hosts that this robot's records name, as ``on=`` does.

        :raises Unsupported: it knows no host.
        """
        known = [*self._asked, *(
            record.spec.options['on'] for record in (
                *Store().machines(), *(record for record, _ in Store().requests()))
            if record.provider == self.name)]
        if not known:
            raise Unsupported('only its host knows a container machine on another computer')
        return known

    def _everywhere(
        self, hosts: Iterable[Mapping[str, Any]], call: str, read: Callable[[str, Any], T],
        **given: Any,
    ) -> Iterator[T]:
        """
        Call a method that returns a list on several hosts.

        :param hosts: as ``on=`` names them.
        :param read: checks and converts an item, which the host with this id has sent.
        :raises FogError: a host does not answer, after the answers of all others.
        """
        asked: set[str] = set()
        failure: Optional[FogError] = None
        for on in hosts:
            try:
                host = self._find_host(on)
                if host in asked:
                    continue
                answer = self._call(host, call, **given)
                with self._reading(host):
                    untrusted.checked(answer, list[Any])
                items = [read(host, item) for item in answer]
            except FogError as error:
                failure = error
                continue
            asked.add(host)
            yield from items
        if failure is not None:
            raise failure

    def destroy(self, machine_id: str) -> None:
        """Remove a container from its host; return when it is removed."""
        self._call_of(machine_id, 'destroy')

    def stop(self, machine_id: str) -> None:
        """Stop a container that was created with ``on_exit='stop'``; its disk stays."""
        self._call_of(machine_id, 'stop')

    def start(self, machine_id: str) -> None:
        """Start a stopped container again."""
        self._call_of(machine_id, 'start')

    def volumes(self, hosts: Sequence[str] = ()) -> Iterator[Volume]:
        """Yield the volumes of the engines on these computers, which nobody else lists."""
        def read(host: str, report: Any) -> Volume:
            with self._reading(host):
                untrusted.checked(report, _Volume)
                identity = untrusted.matched(_VOLUME, report['id'])
            return Volume(f'{_SCHEME}{identity}@{host}', _VOLUME.sub(r'\1', identity),
                          self.name, self._host(host)[0].name, user=report['user'])

        return self._everywhere(({'host': name} for name in hosts), 'volumes', read)

    def attach(self, machine_id: str, name: str, size_gb: int) -> Attached:
        """Return nothing: the engine on the host has mounted the volume."""
        host, identity = _parse(machine_id)
        self._call(host, 'attach', id=identity, name=name, size_gb=size_gb)
        return Attached()

    def detach(self, machine_id: str, name: str) -> None:
        """Do nothing: the machine's end frees the volume."""

    def delete_volume(self, volume_id: str) -> None:
        """Remove a volume from its host."""
        self._call_of(volume_id, 'delete_volume')


def _parse(machine_id: str) -> tuple[str, str]:
    """
    Return the id of a machine's host, and the container's id there.

    :raises MachineNotFound: it is no id of this provider.
    """
    identity, at, host = machine_id.removeprefix(_SCHEME).partition('@')
    if not machine_id.startswith(_SCHEME) or not at:
        raise MachineNotFound(f"'{machine_id}' is no container machine on another computer")
    return host, identity
