# SPDX-License-Identifier: Apache-2.0
"""What launch files call machines: thin constructors of a MachineSpec that ask nobody."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import inspect
import os
import re
import shlex
from typing import Any, cast, ClassVar, get_args, Optional, TYPE_CHECKING, Union

from fogros2 import containers, dependencies
from fogros2.actions import names, networks, words
from fogros2.errors import ConfigurationError, did_you_mean
from fogros2.model import (
    Bootstrap,
    DEFAULT_LIFETIME,
    DEFAULT_ROBOT_TIMEOUT,
    MachineSpec,
    OnExit,
    OnInterrupt,
)
from fogros2.store import check_name
from fogros2.workspace import find_workspaces, underlays

if TYPE_CHECKING:
    from launch import LaunchContext, SomeSubstitutionsType

    from fogros2.actions.coordinator import SomeMachine
    from fogros2.deploy import RunningMachine

    Value = Union[SomeSubstitutionsType, int, float]
    Truth = Union[bool, SomeSubstitutionsType]

_UNITS = {'s': 1.0, 'm': 60.0, 'h': 3600.0, 'd': 86400.0}
_DURATION = re.compile(r'(?:\d+(?:\.\d+)?[smhd])+')


class CloudInstance:
    """
    A machine that a launch asks for; base of one class per provider.

    Building one asks nobody and costs nothing: the machine is made when the first of its nodes
    is executed. Values may be launch substitutions, resolved at that time.

    :param ros_workspace: colcon workspace that travels; None for the one whose install space
        comes first in COLCON_PREFIX_PATH (or AMENT_PREFIX_PATH), '' for none.
    :param working_dir_base: taken for FogROS2's launch files; only :meth:`info` shows it. What is
        known of machines is kept below FOGROS2_STATE_HOME.
    :param launch_foxglove: serve the machine's topics to Foxglove.
    :param name: up to 40 lower-case letters, digits and hyphens, unique on this robot; without
        one each launch makes up its own.
    :param on_exit: what becomes of the machine when the launch ends: 'delete', 'stop' or 'keep'.
        One that stays needs a name, or nobody would find it again.
    :param lifetime: when the machine ends by itself, in seconds or as '8h', '1d12h'.
    :param robot_timeout: how long the launch may be silent before the machine stops its nodes;
        seconds or as above.
    :param bootstrap: how ROS 2 gets there: 'auto', 'apt', 'embedded', 'none'.
    :param environment: variables for every node on the machine; PYTHONPATH, PATH and other lists
        of folders come before the machine's own.
    :param apt: Debian packages that the machine has to have, such as 'libzbar0'.
    :param pip: Python packages that it has to have, as pip takes them ('pyzbar>=0.1.9'). They lie
        behind the system's own: a package that both have is the system's.
    :param on_interrupt: when the provider takes the machine away while its nodes run: 'shutdown'
        ends the launch, with an exit status other than zero; 'robot' starts them anew on the
        robot, which has to have their programs: with the same names and parameters, without
        what they had in memory, a lifecycle state, or components that were loaded.
    :param monitor_allow: networks (CIDR) from which others than the robot may watch: the bridge
        to Foxglove is there for them as well, over TLS and with a token.
    :param options: the provider's own settings, for subclasses to give.
    :raises ConfigurationError: an unknown keyword (with the nearest one), or a wrong value.
    """

    #: Name of the entry point in the group ``fogros2.provider``.
    provider: ClassVar[str] = ''

    def __init__(
        self, ros_workspace: Optional[SomeSubstitutionsType] = None,
        working_dir_base: Optional[SomeSubstitutionsType] = None,
        launch_foxglove: Truth = False, *,
        name: Optional[SomeSubstitutionsType] = None,
        on_exit: SomeSubstitutionsType = 'delete',
        lifetime: Value = DEFAULT_LIFETIME,
        robot_timeout: Value = DEFAULT_ROBOT_TIMEOUT,
        bootstrap: SomeSubstitutionsType = 'auto',
        environment: Optional[Mapping[str, SomeSubstitutionsType]] = None,
        on_interrupt: SomeSubstitutionsType = 'shutdown',
        monitor_allow: Optional[Sequence[SomeSubstitutionsType]] = None,
        apt: Optional[Sequence[SomeSubstitutionsType]] = None,
        pip: Optional[Sequence[SomeSubstitutionsType]] = None,
        options: Optional[Mapping[str, Any]] = None,
        **unknown: object,
    ) -> None:
        if unknown:
            raise self._unknown(next(iter(unknown)))
        if not self.provider:
            raise ConfigurationError(
                f'{type(self).__name__} is no machine yet',
                'use one of its kinds, such as ContainerInstance or AWSCloudInstance')
        self._made_up = name is None
        self._name = names.two_words() if name is None else name
        self._workspace = ros_workspace
        self._working_dir_base = working_dir_base
        self._values: dict[str, Any] = {
            'on_exit': on_exit, 'lifetime': lifetime, 'robot_timeout': robot_timeout,
            'bootstrap': bootstrap, 'on_interrupt': on_interrupt,
        }
        self._environment = dict(environment or {})
        self._options = {k: v for k, v in (options or {}).items() if v is not None}
        self._foxglove = launch_foxglove
        self._monitor_allow = networks.items(monitor_allow)
        self._containers: list[SomeSubstitutionsType] = []
        self._packages = {'apt': _packages('apt', apt), 'pip': _packages('pip', pip)}
        self._spec: Optional[MachineSpec] = None
        self._running: Optional[RunningMachine] = None
        # what is plain is checked where it is written
        for key, value in self._options.items():
            with _named(key):
                words.check_plain(value)
        if isinstance(self._name, str):
            check_name(self._name)
        for key, value in self._values.items():
            if isinstance(value, (str, int, float)):
                _CHECKS[key](key, value)
        if isinstance(on_exit, str):
            self._check_findable(on_exit)

    def _check_findable(self, on_exit: str) -> None:
        if self._made_up and on_exit != 'delete':
            raise ConfigurationError(
                f"a machine with on_exit='{on_exit}' needs a name",
                'give it a name=, so that the next launch finds it')

    def _unknown(self, name: str) -> ConfigurationError:
        known = sorted({
            parameter for cls in type(self).__mro__[:-1]
            for parameter in inspect.signature(cls).parameters
        } - {'self', 'options', 'unknown', 'common'})
        return ConfigurationError(
            f"{type(self).__name__} has no attribute '{name}'", did_you_mean(name, known))

    @property
    def name(self) -> str:
        """The machine's name; described only, while it is a substitution not yet resolved."""
        if self._spec is not None:
            return self._spec.name
        return words.describe(self._name)

    @property
    def own_name(self) -> SomeSubstitutionsType:
        """The name as the launch file has it."""
        return self._name

    @property
    def ip(self) -> Optional[str]:
        """The address the robot reaches the machine at, None while it isn't up."""
        return self._running.machine.vpn_host if self._running else None

    @property
    def vpn_ip(self) -> Optional[str]:
        """The machine's address in the VPN, None while it isn't up."""
        return self._running.vpn_address if self._running else None

    @property
    def is_created(self) -> bool:
        """Whether the machine is up."""
        return self._running is not None

    def info(self, flush_to_disk: bool = False) -> dict[str, Any]:
        """
        Return what is known of the machine, with FogROS2's keys.

        :param flush_to_disk: taken for FogROS2's launch files; the store has it on disk already.
        """
        shell = self._running.machine.shell if self._running else None
        return {
            'name': self.name,
            'cloud_service_provider':
                self._running.spec.provider if self._running else self.provider,
            'ros_workspace': self._spec.workspace if self._spec else words.describe(
                self._workspace),
            'working_dir': self._working_dir_base and words.describe(self._working_dir_base),
            'ssh_key_path': shell.key_file if shell else None,
            'public_ip': self.ip,
            'vpn_ip': self.vpn_ip,
        }

    def apt_install(self, args: str) -> None:
        """
        Have the machine install Debian packages before its nodes start, as ``apt=`` does.

        :param args: their names, with spaces between them.
        :raises ConfigurationError: one is no package's name.
        """
        self._packages['apt'] += _packages('apt', shlex.split(args))

    def pip_install(self, args: str) -> None:
        """
        Have the machine install Python packages before its nodes start, as ``pip=`` does.

        :param args: requirements, with spaces between them.
        :raises ConfigurationError: one is no requirement, or is part of FogROS2.
        """
        self._packages['pip'] += _packages('pip', shlex.split(args))

    def add_docker_container(
        self, cmd: Optional[SomeSubstitutionsType] = None, *, image: str = '', **parts: Any,
    ) -> None:
        """
        Run a container on the machine from before its nodes start until they have ended.

        Its nodes hear the launch's: unless the options say otherwise it has the machine's network
        and the variables and configuration of the middleware.

        :param cmd: a ``docker run`` command line.
        :param image: instead of that, the container's image, with any of ``command``, ``ports``,
            ``environment``, ``volumes``, ``gpus``, ``restart``, ``name``: see
            :func:`fogros2.containers.described`.
        :raises ConfigurationError: it is neither, or both.
        """
        if bool(cmd) == bool(image) or cmd and parts:
            raise ConfigurationError(
                'add_docker_container takes a command line, or image= and the rest by name',
                "such as 'docker run --net=host IMAGE'")
        if image:
            try:
                cmd = containers.described(image, **parts)
            except TypeError as error:
                raise ConfigurationError(
                    f'add_docker_container: {error}',
                    f"there are: {', '.join(inspect.signature(containers.described).parameters)}"
                ) from error
        assert cmd is not None
        if isinstance(cmd, str):
            containers.parse(cmd)
        self._containers.append(cmd)
        self.takes_containers()

    def takes_containers(self) -> None:
        """Note that containers will run on the machine."""

    def is_up(self, running: RunningMachine) -> None:
        """Note that the machine is up; called by the launch."""
        self._running = running

    def spec(self, context: LaunchContext) -> MachineSpec:
        """
        Resolve everything, once, and return the description that the core works with.

        :raises ConfigurationError: a value is wrong.
        """
        if self._spec is None:
            values = {
                key: _CHECKS[key](key, words.resolve(context, value))
                for key, value in self._values.items()}
            self._check_findable(values['on_exit'])
            workspace = words.resolve(context, self._workspace)
            chain = find_workspaces(context.environment)
            if workspace is None:
                workspace = next(iter(chain), None)
            elif workspace:
                workspace = os.path.abspath(os.path.expanduser(workspace))
            name = words.resolve(context, self._name)
            self._spec = MachineSpec(
                name=check_name(name),
                provider=self.provider,
                options={
                    key: self._resolved(context, key, value)
                    for key, value in self._options.items()},
                workspace=workspace or None, underlays=underlays(workspace or None, chain),
                environment={
                    key: words.resolve(context, value)
                    for key, value in self._environment.items()},
                containers=tuple(words.resolve(context, line) for line in self._containers),
                launch_foxglove=self._resolved(
                    context, 'launch_foxglove', words.Truth(self._foxglove)),
                monitor_allow=networks.resolve(context, self._monitor_allow),
                apt=self._wanted(context, 'apt'), pip=self._wanted(context, 'pip'),
                **values)
        return self._spec

    def _wanted(self, context: LaunchContext, program: str) -> tuple[str, ...]:
        values = [value for some in self._packages[program]
                  for value in words.resolve(context, some)]
        return tuple(dict.fromkeys(_PACKAGE_CHECKS[program](value) for value in values))

    def _resolved(self, context: LaunchContext, keyword: str, value: Any) -> Any:
        with _named(keyword):
            return words.resolve_later(context, value)

    def _option(self, name: str) -> Any:
        """Return an option: as it was resolved, or what is to be read of it until then."""
        if self._running is not None:
            return self._running.spec.options.get(name)
        value = (self._spec.options if self._spec else self._options).get(name)
        return words.plain(value)


class ContainerInstance(CloudInstance):
    """
    A container on this computer that behaves like a cloud machine of its own.

    :param image: what it is made of; None for this computer's own root, seen through an
        allow-list (podman alone).
    :param isolated: give it the root of a new system of this computer's release, made once by
        debootstrap, in place of this computer's own: it has none of the packages that are
        installed here, as a new machine in a cloud.
    :param engine: 'podman' or 'docker'; None for the one that works.
    :param user: login user, made if needed.
    :param network: name of an existing container network; None for the engine's own.
    :param ip: fixed address in that network.
    :param cpus: limit, such as 1.5.
    :param memory: limit, such as '2g'.
    :param ports: what is published on the robot, in the engine's form.
    :param mounts: folders of this computer that the container sees: ``path`` or
        ``path:path there``; it can't write to them.
    :param gpus: 'all' or a number.
    :param devices: such as '/dev/video0'.
    :param containers: whether it may run containers of its own, which takes rights that make it
        little of a wall; None where ``add_docker_container`` or a node's ``image`` asks for it.
    """

    provider = 'container'

    def __init__(
        self, *, image: Optional[SomeSubstitutionsType] = None,
        isolated: Optional[Truth] = None,
        engine: Optional[SomeSubstitutionsType] = None,
        network: Optional[SomeSubstitutionsType] = None,
        ip: Optional[SomeSubstitutionsType] = None,
        cpus: Optional[Value] = None,
        memory: Optional[SomeSubstitutionsType] = None,
        ports: Optional[Sequence[SomeSubstitutionsType]] = None,
        mounts: Optional[Sequence[SomeSubstitutionsType]] = None,
        user: Optional[SomeSubstitutionsType] = None,
        gpus: Optional[SomeSubstitutionsType] = None,
        devices: Optional[Sequence[SomeSubstitutionsType]] = None,
        containers: Optional[Truth] = None,
        **common: Any,
    ) -> None:
        super().__init__(options={
            'image': image, 'isolated': words.truth(isolated), 'engine': engine,
            'network': network, 'ip': ip,
            'cpus': words.number(cpus), 'memory': memory, 'ports': words.items(ports),
            'mounts': words.items(mounts), 'user': user, 'gpus': gpus,
            'devices': words.items(devices),
            'containers': words.truth(containers),
        }, **common)

    def takes_containers(self) -> None:
        """Have the machine made with the rights that an engine takes, if nothing else is said."""
        self._options.setdefault('containers', words.Truth(True))


class SSHInstance(CloudInstance):
    """
    Any computer that exists already and takes our SSH key; it outlives the launch.

    :param host: name or address.
    :param user: login user; None for what ``ssh`` would use.
    :param port: TCP port of its SSH server.
    :param key: private key file to log in with; None for the user's own keys and agent.
    :param host_key: its public host key (``ssh-ed25519 AAAA...``); None lets known_hosts decide.
    """

    provider = 'ssh'

    def __init__(
        self, host: SomeSubstitutionsType, user: Optional[SomeSubstitutionsType] = None,
        port: Value = 22, key: Optional[SomeSubstitutionsType] = None,
        host_key: Optional[SomeSubstitutionsType] = None, **common: Any,
    ) -> None:
        super().__init__(options={
            'host': host, 'user': user, 'port': port, 'key': key, 'host_key': host_key,
        }, **common)


def checked(machine: SomeMachine) -> SomeMachine:
    """
    Return a machine, or the name of one, as launch files pass it.

    :raises ConfigurationError: it is neither.
    """
    if not isinstance(machine, CloudInstance) and not words.is_text(machine):
        raise ConfigurationError(
            f'machine={machine!r} is no machine',
            'pass one such as ContainerInstance(), or the name of one')
    return machine


def parse_duration(what: str, value: Union[str, int, float]) -> float:
    """
    Return seconds for a number, or for text such as '90', '8h', '1h30m', '2d'.

    :raises ConfigurationError: not a duration, or not above zero.
    """
    seconds = 0.0
    if isinstance(value, str):
        text = value.replace(' ', '')
        try:
            seconds = float(text)
        except ValueError:
            if _DURATION.fullmatch(text):
                seconds = sum(
                    float(number) * _UNITS[unit]
                    for number, unit in re.findall(r'([\d.]+)([smhd])', text))
    else:
        seconds = float(value)
    if not 0 < seconds < float('inf'):
        raise ConfigurationError(
            f'{what}={value!r} is no duration', "use seconds, or text such as '8h' or '1h30m'")
    return seconds


@contextlib.contextmanager
def _named(keyword: str) -> Iterator[None]:
    """Have an error in the value of a keyword say which it is."""
    try:
        yield
    except ConfigurationError as error:
        raise ConfigurationError(f'{keyword}: {error.args[0]}', error.hint) from error


def _choice(kind: Any) -> Any:
    def check(what: str, value: object) -> str:
        if value not in get_args(kind):
            raise ConfigurationError(
                f'{what}={value!r} is unknown',
                did_you_mean(str(value), get_args(kind),
                             f"use one of {', '.join(get_args(kind))}"))
        return cast(str, value)
    return check


_PACKAGE_CHECKS = {'apt': dependencies.check_apt, 'pip': dependencies.check_pip}


def _packages(program: str, values: Any) -> list[Union[words.Items, words.Listed]]:
    """
    Return what ``apt=`` or ``pip=`` takes, each checked as far as it is known.

    :raises ConfigurationError: it is no list of packages.
    """
    if isinstance(values, str):
        raise ConfigurationError(f'{program}={values!r} is no list',
                                 f'{program}=[{values!r}]')
    found = words.items(values)
    for value in found if isinstance(found, words.Items) else ():
        if isinstance(value, str):
            _PACKAGE_CHECKS[program](value)
    return [] if found is None else [found]


_CHECKS: dict[str, Any] = {
    'on_exit': _choice(OnExit),
    'bootstrap': _choice(Bootstrap),
    'on_interrupt': _choice(OnInterrupt),
    'lifetime': parse_duration,
    'robot_timeout': parse_duration,
}
