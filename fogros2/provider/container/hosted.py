# SPDX-License-Identifier: Apache-2.0
"""
Container machines on another computer, the host of a fleet: one for each robot.

The host has an SSH server and a container engine, and keeps nothing running for FogROS2. The
program ``served`` creates the container there, whose agent then ends it without the robot. The
robot reaches the container at ports that the engine publishes on the host.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import dataclasses
import functools
import gzip
import hashlib
import json
from pathlib import Path
import threading
from typing import Any, ClassVar

from fogros2 import model, plugin_system
from fogros2.errors import (
    ConfigurationError,
    ConnectError,
    FogError,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
    ProviderError,
    Unsupported,
)
from fogros2.events import clean
from fogros2.model import Command, CreateRequest, Endpoint, Machine, MachineSpec, MachineState
from fogros2.provider import Capabilities, Provider, TAG_NAME
from fogros2.provider.container import ContainerProvider
from fogros2.provider.container import entry as container_entry
from fogros2.provider.container.options import Options
from fogros2.provider.container.root import Archive
from fogros2.provider.container.served import Report
from fogros2.provider.options import parsed
from fogros2.shell import connect, Shell
from fogros2.shell.command_line import checked
from fogros2.store import robot_id, Store

_SCHEME = 'hosted:'
#: Marks the containers that robots have on a host, besides the host's own machines.
_HOSTED = {'fogros2-hosted': 'yes'}
#: Seconds for one call on the host; a creation may download an image.
_TIMEOUT, _CREATE_TIMEOUT = 90.0, 1900.0

#: Errors of the host that stay what they are; all others are a ProviderError.
_KINDS: Mapping[str, type[FogError]] = {kind.__name__: kind for kind in (
    ConfigurationError, PrerequisiteError, MachineNotFound, NameTaken, Unsupported)}
#: The modules that the host runs.
_SENT = ('*.py', 'agent/*.py', 'agent_client/*.py', 'shell/*.py', 'provider/*.py',
         'provider/container/*.py')
#: Exit status of ``_SERVE`` on a host that lacks the modules.
_LACKING = 75
_FOLDER = 'folder=${XDG_CACHE_HOME:-$HOME/.cache}/fogros2/host-$1\n'
# The machines show the host's ROS 2, if it has one.
_SERVE = _FOLDER + f"""\
cd "$folder" 2>/dev/null || exit {_LACKING}
for setup in /opt/ros/*/setup.sh; do [ ! -e "$setup" ] || . "$setup"; done
exec python3 -m fogros2.provider.container.served
"""
_KEEP = _FOLDER + """\
mkdir -p "${folder%/*}"
aside=$(mktemp -d "$folder.XXXXXX")
trap 'rm -rf -- "$aside"' EXIT
tar -xzf - --no-same-owner -C "$aside"
mv -T "$aside" "$folder" 2>/dev/null || [ -d "$folder" ]
"""


@functools.lru_cache(maxsize=1)
def program() -> tuple[bytes, str]:
    """Return the archive of the modules that a host runs, and its hash."""
    archive, top = Archive(), Path(model.__file__).parent
    for pattern in _SENT:
        for path in sorted(top.glob(pattern)):
            archive.file(f'fogros2/{path.relative_to(top)}', path.read_bytes())
    data = gzip.compress(archive.data(), mtime=0)
    return data, hashlib.sha256(data).hexdigest()[:16]


def result_of(text: str, name: str) -> Any:
    """
    Return the result in the output of ``served``.

    :param name: the host's name, for messages.
    :raises FogError: the error of the call on the host.
    """
    try:
        found = json.loads(text.splitlines()[-1])
        if 'error' not in found:
            return found['result']
        error = _KINDS.get(found['error'], ProviderError)(
            clean(str(found['message'])), clean(str(found['hint'])))
    except (ValueError, LookupError, TypeError, AttributeError) as invalid:
        raise ProviderError(
            f"the host '{name}' sent no answer, but {text[-200:]!r}",
            'its login must print nothing after a command') from invalid
    raise error


class HostedProvider(Provider):
    """Containers of podman or docker on a computer with an SSH server."""

    name: ClassVar[str] = 'hosted'
    capabilities: ClassVar[Capabilities] = ContainerProvider.capabilities
    poll_interval: ClassVar[float] = 0.3

    def __init__(self) -> None:
        self._ssh: Provider = plugin_system.load('fogros2.provider', 'ssh')()
        #: Ids of the hosts at the provider of SSH machines, with their machines there.
        self._hosts: dict[str, tuple[Machine, Shell]] = {}
        self._asked: dict[str, Mapping[str, Any]] = {}
        self._lock = threading.Lock()

    # -- the host -------------------------------------------------------------------------------

    def _find_host(self, on: Mapping[str, Any]) -> str:
        """Return the id of the host that an option ``on`` describes."""
        return self._ssh.create(MachineSpec(str(on['host']), 'ssh', on),
                                CreateRequest('', '', {}, 0))

    def _host(self, host: str) -> tuple[Machine, Shell]:
        with self._lock:
            if host not in self._hosts:
                machine = self._ssh.describe(host)
                if machine.shell is None:
                    raise ConnectError(f"the host '{machine.name}' does not answer",
                                       'is it on, and reachable from this robot?')
                self._hosts[host] = machine, connect(machine.shell, name=machine.name)
            return self._hosts[host]

    def _call(self, host: str, call: str, **given: Any) -> Any:
        """
        Call a method of the container provider on a host.

        :raises FogError: the method's error, or the host cannot be reached.
        """
        machine, shell = self._host(host)
        data, key = program()
        run = functools.partial(
            shell.run, check=False, cancel=self.cancel if call == 'create' else None,
            timeout=_CREATE_TIMEOUT if call == 'create' else _TIMEOUT)
        ask = Command(('sh', '-c', _SERVE, 'sh', key), what=f'{call} a container machine',
                      input=model.to_json({'call': call, 'given': given}).encode())
        done = run(ask)
        if done.returncode == _LACKING:
            shell.run(Command(('sh', '-ec', _KEEP, 'sh', key), input=data,
                              what='send the program for container machines'), timeout=_TIMEOUT)
            done = run(ask)
        return result_of(checked(ask, done, f"'{machine.name}'").stdout, machine.name)

    # -- before a machine exists ----------------------------------------------------------------

    def check(self, spec: MachineSpec) -> None:
        """Check the options without a connection; the host checks their values."""
        self._ssh.check(MachineSpec(spec.name, 'ssh', self._options(spec)[0]))
        if spec.monitor_allow:
            raise Unsupported(f"'{spec.name}' can't open a port of its host for monitor_allow",
                              "leave it out, and use 'ros2 fog monitor'")

    def _options(self, spec: MachineSpec) -> tuple[Mapping[str, Any], dict[str, Any]]:
        """
        Return the options of the host, and of the container.

        :raises ConfigurationError: one is unknown, or has another type.
        """
        options = dict(spec.options)
        on = options.pop('on', None)
        if not isinstance(on, Mapping) or not on.get('host'):
            raise ConfigurationError(f"on= of '{spec.name}' names no host",
                                     "write on=SSHInstance('gpu-box')")
        parsed(Options, options, 'a container machine')
        self._asked[spec.name] = on
        return on, options

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
        # two robots may have machines of the same name
        name = f'{spec.name}-{hashlib.sha256(robot_id().encode()).hexdigest()[:8]}'
        options['ports'] = [*(options.get('ports') or ()), '22', f'{request.vpn_port}/udp']
        try:
            identity = self._call(
                host, 'create',
                spec={'name': name, 'provider': ContainerProvider.name, 'options': options,
                      'on_exit': spec.on_exit, 'containers': spec.containers},
                request=dataclasses.replace(request, tags={**request.tags, **_HOSTED}))
        except FogError as error:
            error.args = (str(error.args[0]).replace(name, spec.name),)
            error.hint = error.hint.replace(name, spec.name)
            raise
        return f'{_SCHEME}{identity}@{host}'

    def describe(self, machine_id: str) -> Machine:
        """Return the state of a container, from the host."""
        host, identity = _parse(machine_id)
        return self._machine(host, self._call(host, 'describe', id=identity))

    def _machine(self, host: str, found: Any) -> Machine:
        machine, _ = self._host(host)
        try:
            report = parsed(Report, found, 'the report')
            state = MachineState(report.state)
        except (ConfigurationError, ValueError, TypeError) as error:
            raise ProviderError(
                f"the host '{machine.name}' reports a machine wrongly: {error}") from error
        outside = machine.shell
        assert outside is not None
        shell = None
        if report.host_key and report.ssh_port:
            shell = Endpoint('ssh', outside.host, report.ssh_port, report.user, report.host_key)
        return Machine(
            f'{_SCHEME}{report.id}@{host}', report.tags.get(TAG_NAME, ''), self.name,
            state, report.created, shell, machine.vpn_host, report.vpn_port,
            # the host's packet filter admits no machine to the host's ports
            private_network=host, private_ip=report.address, region=machine.name,
            image=report.image, tags=report.tags, end_command=container_entry.END_COMMAND)

    def find(self, tags: Mapping[str, str]) -> Iterator[Machine]:
        """
        Yield the containers on the hosts that this robot's records name.

        :raises Unsupported: it knows no host.
        """
        known = {_parse(record.machine_id)[0]: None for record in Store().machines()
                 if record.provider == self.name and record.machine_id is not None}
        asked = [*self._asked.values(), *(
            record.spec.options['on'] for record in Store().machines()
            if record.provider == self.name and record.machine_id is None)]
        known.update({self._find_host(on): None for on in asked})
        if not known:
            raise Unsupported('only its host knows a container machine on another computer')
        for host in known:
            for found in self._call(host, 'find', tags={**tags, **_HOSTED}):
                yield self._machine(host, found)

    def destroy(self, machine_id: str) -> None:
        """Remove a container from its host; return when it is removed."""
        with contextlib.suppress(MachineNotFound):
            host, identity = _parse(machine_id)
            self._call(host, 'destroy', id=identity)

    def stop(self, machine_id: str) -> None:
        """Stop a container that was created with ``on_exit='stop'``; its disk stays."""
        host, identity = _parse(machine_id)
        self._call(host, 'stop', id=identity)

    def start(self, machine_id: str) -> None:
        """Start a stopped container again."""
        host, identity = _parse(machine_id)
        self._call(host, 'start', id=identity)


def _parse(machine_id: str) -> tuple[str, str]:
    """
    Return the id of a machine's host, and the container's id there.

    :raises MachineNotFound: it is no id of this provider.
    """
    identity, at, host = machine_id.removeprefix(_SCHEME).partition('@')
    if not machine_id.startswith(_SCHEME) or not at:
        raise MachineNotFound(f"'{machine_id}' is no container machine on another computer")
    return host, identity
