# SPDX-License-Identifier: Apache-2.0
"""Machines in launch files: constructors that describe a MachineSpec and make no request."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
import functools
import os
import shlex
from typing import Any, NoReturn, Optional, TYPE_CHECKING, Union

from fogros2.describe import features, names, values, variables
from fogros2.describe.kinds import check, names_of, options_of, parameters_of
from fogros2.errors import ConfigurationError, did_you_mean
from fogros2.feature import contained
from fogros2.host import dependencies
from fogros2.host.workspace import find_workspaces, underlays
from fogros2.model import Bootstrap, MachineSpec, OnExit
from fogros2.store import check_name

if TYPE_CHECKING:
    from launch import LaunchContext, SomeSubstitutionsType

    from fogros2.deploy import RunningMachine

    Value = Union[SomeSubstitutionsType, int, float]
    Bool = Union[bool, SomeSubstitutionsType]
    Scalar = Union[Value, bool]
    #: A machine in a launch file; a name may be of a machine that is mentioned elsewhere.
    SomeMachine = Union['CloudInstance', SomeSubstitutionsType]


class CloudInstance:
    """
    A machine that a launch requests; the base class of one class for each provider.

    The constructor makes no request and costs nothing. The launch creates the machine when it
    executes the machine's first node, and resolves substitutions in the values at that time.

    :param ros_workspace: colcon workspace that is sent to the machine; None for the one whose
        install space comes first in COLCON_PREFIX_PATH (or AMENT_PREFIX_PATH), '' for none.
        Its sourced underlays are sent too.
    :param working_dir_base: accepted for FogROS2's launch files; only :meth:`info` shows it. The
        records of machines are below FOGROS2_STATE_HOME.
    :param name: up to 40 lower-case letters, digits and hyphens, unique on this robot; without
        a name, each launch invents one.
    :param on_exit: what happens to the machine when the launch ends: 'delete', 'stop' or 'keep'.
        With 'stop' and 'keep' a name is required, so that a later launch finds the machine.
    :param lifetime: time until the machine ends by itself, in seconds or as '1d12h'; 8 hours.
    :param robot_timeout: time without contact to the launch until the machine stops its nodes;
        seconds or as above; 2 minutes. A machine that the launch has not reached yet ends
        6 minutes after its boot (a pod: 10 minutes, or this time if it is longer).
    :param bootstrap: how to install ROS 2 there: 'auto' (the default), 'apt', 'pip', 'none'.
    :param environment: variables for every node on the machine; PYTHONPATH, PATH and other lists
        of folders are prepended to the machine's own.
    :param apt: Debian packages that the machine needs, such as 'libzbar0'.
    :param pip: Python packages that the machine needs, in pip's syntax ('pyzbar>=0.1.9'). If the
        system has the same package, the system's version is used.
    :param options: the provider's own options; subclasses set it.
    :param unknown: keywords of features, see doc/developers/features.md.
    :raises ConfigurationError: an unknown keyword (the hint names the nearest), or a wrong value.
    """

    #: Name of the entry point in the group ``fogros2.provider``.
    provider: str = ''

    def __init__(
        self, ros_workspace: Optional[SomeSubstitutionsType] = None,
        working_dir_base: Optional[SomeSubstitutionsType] = None, *,
        name: Optional[SomeSubstitutionsType] = None,
        on_exit: SomeSubstitutionsType = 'delete',
        lifetime: Optional[Value] = None,
        robot_timeout: Optional[Value] = None,
        bootstrap: Optional[SomeSubstitutionsType] = None,
        environment: Optional[Mapping[str, SomeSubstitutionsType]] = None,
        apt: Optional[Sequence[SomeSubstitutionsType]] = None,
        pip: Optional[Sequence[SomeSubstitutionsType]] = None,
        options: Optional[Mapping[str, Any]] = None,
        **unknown: object,
    ) -> None:
        parameters = locals()
        self._features = features.own(unknown) if unknown else {}
        for keyword in unknown:
            if keyword not in self._features:
                raise ConfigurationError(
                    f"{type(self).__name__} has no attribute '{keyword}'", did_you_mean(
                        keyword, sorted({*names_of(type(self)), *features.keywords()})))
        if not self.provider:
            raise ConfigurationError(
                f'{type(self).__name__} is no machine yet',
                'use one of its kinds, such as ContainerInstance or AWSCloudInstance')
        check(parameters_of(CloudInstance.__init__), parameters)
        self._made_up = name is None
        self._name = names.two_words() if name is None else name
        self._workspace = ros_workspace
        self._working_dir_base = working_dir_base
        self._values = {name: parameters[name] for name in _CHECKS if parameters[name] is not None}
        self._environment = dict(environment or {})
        self._options = {k: v for k, v in (options or {}).items() if v is not None}
        self._lists = {'apt': _listed('apt', apt), 'pip': _listed('pip', pip)}
        self._spec: Optional[MachineSpec] = None
        self._running: Optional[RunningMachine] = None
        # values that are known already are checked where they are written
        values.known({key: value for key, value in self._options.items()
                      if values.is_known(value)})
        if isinstance(self._name, str):
            check_name(self._name)
        for key, value in self._values.items():
            if isinstance(value, (str, int, float)):
                _CHECKS[key](key, value)
        if isinstance(on_exit, str):
            self._check_findable(on_exit)

    def __getattr__(self, name: str) -> Any:
        """Return a method of features, which adds an item to a list."""
        element = name.removeprefix('add_')
        if element == name or element not in features.machine_lists():
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")
        return functools.partial(self._add, *features.machine_lists()[element])

    def _add(self, keyword: str, item: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
        added = features.own({keyword: [item(*args, **kwargs)]})[keyword]
        self._features[keyword] = values.Items((*(self._features.get(keyword) or ()), *added))

    def _check_findable(self, on_exit: str) -> None:
        if self._made_up and on_exit != 'delete':
            raise ConfigurationError(
                f"a machine with on_exit='{on_exit}' needs a name",
                'give it a name=, so that the next launch finds it')

    @property
    def name(self) -> str:
        """The machine's name; a description while it is an unresolved substitution."""
        if self._spec is not None:
            return self._spec.name
        return values.describe(self._name)

    @property
    def settings(self) -> list[str]:
        """The keywords of every machine that the launch file gives, of those in ``SETTINGS``."""
        return list(self._values)

    @property
    def own_name(self) -> SomeSubstitutionsType:
        """The name as the launch file gives it, or as the launch has resolved it."""
        return self._name if self._spec is None else self._spec.name

    @property
    def ip(self) -> Optional[str]:
        """The address at which the robot reaches the machine, None until the machine is up."""
        return self._running.machine.vpn_host if self._running else None

    @property
    def vpn_ip(self) -> Optional[str]:
        """The machine's address in the VPN, None until the machine is up."""
        return self._running.vpn_address if self._running else None

    @property
    def is_created(self) -> bool:
        """Whether the machine is up."""
        return self._running is not None

    def info(self, flush_to_disk: bool = False) -> dict[str, Any]:
        """
        Return what is known about the machine, with FogROS2's keys.

        :param flush_to_disk: accepted for FogROS2's launch files; the record is on disk already.
        """
        endpoint = self._running.machine.endpoint if self._running else None
        return {
            'name': self.name,
            'cloud_service_provider':
                self._running.spec.provider if self._running else self.provider,
            'ros_workspace': self._spec.workspace if self._spec else values.describe(
                self._workspace),
            'working_dir': self._working_dir_base and values.describe(self._working_dir_base),
            'ssh_key_path': endpoint.key_file if endpoint else None,
            'public_ip': self.ip,
            'vpn_ip': self.vpn_ip,
        }

    def apt_install(self, args: str) -> None:
        """
        Install Debian packages on the machine before its nodes start, as ``apt=`` does.

        :param args: package names, separated by spaces.
        :raises ConfigurationError: an invalid package name.
        """
        self._lists['apt'] += _listed('apt', shlex.split(args))

    def pip_install(self, args: str) -> None:
        """
        Install Python packages on the machine before its nodes start, as ``pip=`` does.

        :param args: requirements, separated by spaces.
        :raises ConfigurationError: an invalid requirement, or a package that FogROS2 contains.
        """
        self._lists['pip'] += _listed('pip', shlex.split(args))

    def takes_containers(self) -> None:
        """Note that containers will run on the machine; a provider's class may override it."""

    def visit(self, context: object = None) -> NoReturn:
        """Refuse a machine among the actions of a launch description; launch calls this."""
        raise ConfigurationError('a machine alone does nothing in a launch description',
                                 'give it to a node: Node(machine=...)')

    #: launch asks for these before it visits an entity.
    describe_sub_entities = visit

    def is_up(self, running: RunningMachine) -> None:
        """Note that the machine is up; the launch calls this."""
        self._running = running

    def spec(self, context: LaunchContext) -> MachineSpec:
        """
        Resolve all values, once; return the machine's spec.

        :raises ConfigurationError: a wrong value.
        """
        if self._spec is None:
            settings = {
                key: _CHECKS[key](key, values.resolve(context, value))
                for key, value in self._values.items()}
            workspace = values.resolve(context, self._workspace)
            chain = find_workspaces(context.environment)
            if workspace is None:
                workspace = next(iter(chain), None)
            elif workspace:
                workspace = os.path.abspath(os.path.expanduser(str(workspace)))
            of_features = features.by_feature({
                key: self._resolved(context, key, value)
                for key, value in self._features.items()})
            if contained(of_features):
                self.takes_containers()
            spec = MachineSpec(
                name=check_name(str(values.resolve(context, self._name))),
                provider=self.provider,
                options={
                    key: self._resolved(context, key, value)
                    for key, value in self._options.items()},
                workspace=workspace or None, underlays=underlays(workspace or None, chain),
                environment=variables.to_send({
                    key: str(self._resolved(context, 'environment', value))
                    for key, value in self._environment.items()}, context.environment),
                apt=self._wanted(context, 'apt'), pip=self._wanted(context, 'pip'),
                features=of_features, **settings)
            self._check_findable(spec.on_exit)
            self._spec = spec
        return self._spec

    def _wanted(self, context: LaunchContext, program: str) -> tuple[str, ...]:
        wanted = [value for some in self._lists[program]
                  for value in values.resolve(context, some)]
        return tuple(dict.fromkeys(_LIST_CHECKS[program](str(value)) for value in wanted))

    def _resolved(self, context: LaunchContext, keyword: str, value: Any) -> Any:
        with values.named(keyword):
            return values.resolve_deferred(context, value)

    def _option(self, name: str) -> Any:
        """Return an option's value of the region: resolved once up, else plain or described."""
        described = self._running.spec if self._running else self._spec
        options = described.options if described else self._options
        region, value = (values.plain(options.get(key)) for key in ('region', name))
        return value.get(region, value) if isinstance(value, Mapping) else value


class ContainerInstance(CloudInstance):
    """
    A container on this computer, or on another one, that behaves like a separate cloud machine.

    :param on: the computer that hosts the container, an ``SSHInstance``, of which only ``host``,
        ``user``, ``port``, ``key`` and ``host_key`` count; None for this computer. What follows is
        about the host then: "this computer", and where its ports and folders are.
    :param image: its container image; None for this computer's own root file system, restricted
        by an allow-list (podman only).
    :param isolated: use the root file system of a new installation of this computer's release
        instead, created once by debootstrap. Like a new machine in a cloud, it has none of the
        packages that are installed on this computer.
    :param engine: 'podman' or 'docker'; None for the one that works.
    :param user: login user, created if needed.
    :param network: name of an existing container network; None for the engine's default.
    :param cpus: CPU limit, such as 1.5.
    :param memory: memory limit, such as '2g'.
    :param ports: ports to publish on the robot, in the engine's syntax.
    :param mounts: folders of this computer that the container can read: ``path`` or
        ``path:path there``.
    :param gpus: 'all' or a number.
    :param devices: such as '/dev/video0'.
    :param containers: whether it may run containers of its own, which weakens its isolation;
        None: only if a container beside the nodes, or of one, requires it.
    """

    provider = 'container'

    def __init__(
        self, *, on: Union[SSHInstance, Mapping[str, str], None] = None,
        image: Optional[SomeSubstitutionsType] = None,
        isolated: Optional[Bool] = None,
        engine: Optional[SomeSubstitutionsType] = None,
        network: Optional[SomeSubstitutionsType] = None,
        cpus: Optional[Value] = None,
        memory: Optional[SomeSubstitutionsType] = None,
        ports: Optional[Sequence[SomeSubstitutionsType]] = None,
        mounts: Optional[Sequence[SomeSubstitutionsType]] = None,
        user: Optional[SomeSubstitutionsType] = None,
        gpus: Optional[SomeSubstitutionsType] = None,
        devices: Optional[Sequence[SomeSubstitutionsType]] = None,
        containers: Optional[Bool] = None,
        **common: Any,
    ) -> None:
        options = options_of(ContainerInstance.__init__, {**locals(), 'on': None})
        if on is not None:
            self.provider = 'hosted'
            options['on'] = on._options if isinstance(on, SSHInstance) else on
            if not isinstance(options['on'], Mapping):
                raise ConfigurationError(
                    f'on={type(on).__name__} is no host of container machines',
                    'use SSHInstance; fleet= makes a machine of a cloud one')
        super().__init__(options=options, **common)

    def takes_containers(self) -> None:
        """Create the machine with the rights that a container engine needs, by default."""
        self._options.setdefault('containers', values.Bool(True))


class SSHInstance(CloudInstance):
    """
    An existing computer that accepts the robot's SSH key; it outlives the launch.

    ``~/.ssh/config`` holds for it as for ``ssh``.

    :param host: name or address, or a name of ``~/.ssh/config``.
    :param user: login user; None for the user that ``ssh`` would choose.
    :param port: TCP port of its SSH server; None or 0 for the port that ``ssh`` chooses.
    :param key: private key file for the login; None for those that ``ssh`` would try.
    :param host_key: its public host key (``ssh-ed25519 AAAA...``); None to use known_hosts.
    """

    provider = 'ssh'

    def __init__(
        self, host: SomeSubstitutionsType, user: Optional[SomeSubstitutionsType] = None,
        port: Optional[Value] = None, key: Optional[SomeSubstitutionsType] = None,
        host_key: Optional[SomeSubstitutionsType] = None, **common: Any,
    ) -> None:
        super().__init__(options=options_of(SSHInstance.__init__, locals()), **common)


def checked(machine: SomeMachine) -> SomeMachine:
    """
    Check that a value is a machine, or the name of one; return it.

    :raises ConfigurationError: it is neither.
    """
    if not isinstance(machine, CloudInstance) and not values.is_text(machine):
        raise ConfigurationError(
            f'machine={machine!r} is no machine',
            'pass one such as ContainerInstance(), or the name of one')
    return machine


def unknown_machine(name: str, known: Collection[str]) -> ConfigurationError:
    """Return the error for a name of none of a launch's machines."""
    return ConfigurationError(
        f"this launch has no machine named '{name}'",
        did_you_mean(name, known,
                     'name one that the launch file describes before, or pass the machine itself'))


_LIST_CHECKS = {'apt': dependencies.check_apt, 'pip': dependencies.check_pip}


def _listed(program: str, content: Any) -> list[Union[values.Items, values.List]]:
    """
    Read a value of ``apt=`` or ``pip=``; check the items that are known already.

    :raises ConfigurationError: not a list, or a wrong item.
    """
    items = values.items(content)
    for value in items if isinstance(items, values.Items) else ():
        if isinstance(value, str):
            _LIST_CHECKS[program](value)
    return [] if items is None else [items]


def _lifetime(keyword: str, value: Union[str, int, float]) -> float:
    """
    Convert a lifetime to seconds.

    :raises ConfigurationError: it is no duration, or hours or minutes without their unit.
    """
    seconds = values.parse_duration(keyword, value)
    if seconds < 60 and not str(value)[-1:].isalpha():
        raise ConfigurationError(f'{keyword}={value!r} would be {seconds:g} seconds',
                                 f"write the unit, such as '{seconds:g}h' or '{seconds:g}s'")
    return seconds


_CHECKS: dict[str, Any] = {
    'on_exit': values.choice(OnExit),
    'bootstrap': values.choice(Bootstrap),
    'lifetime': _lifetime,
    'robot_timeout': values.parse_duration,
}
#: Keywords of every machine that a file of defaults may have.
SETTINGS = tuple(name for name in _CHECKS if name != 'on_exit')


def check_setting(name: str, value: Any) -> Any:
    """
    Return the value of a keyword in ``SETTINGS`` as a MachineSpec has it.

    :raises ConfigurationError: a wrong value.
    """
    return _CHECKS[name](name, value)
