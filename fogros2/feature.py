# SPDX-License-Identifier: Apache-2.0
"""
What a package can add to machines and their nodes: keywords, a check, and steps with their undo.

A feature is an entry point in the group ``fogros2.feature``. doc/developers/features.md shows how
to write one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
from decimal import Decimal
import inspect
from pathlib import Path
import threading
from typing import Any, ClassVar, Optional, Protocol, TYPE_CHECKING

from fogros2 import plugin_system
from fogros2.errors import ConfigurationError
from fogros2.model import (
    Command,
    CreateRequest,
    Endpoint,
    Machine,
    MachineSpec,
    NodeSpec,
    OtherVpn,
    VpnInterface,
)
from fogros2.shell import Shell
from fogros2.store import Record

if TYPE_CHECKING:
    from fogros2.provider import Provider

#: The group of entry points.
GROUP = 'fogros2.feature'


@dataclasses.dataclass(frozen=True)
class Cost:
    """
    What a machine costs its launch.

    :param price: US dollars per hour, None if unknown.
    :param seconds: for which it has run in the launch, 0 before it exists.
    :param ended: whether it costs nothing any more.
    """

    spec: MachineSpec
    price: Optional[Decimal]
    seconds: float = 0.0
    ended: bool = False

    @property
    def spent(self) -> Decimal:
        """US dollars so far, 0 if the price is unknown."""
        return (self.price or Decimal(0)) * Decimal(self.seconds) / 3600


class ReachedMachine(Protocol):
    """A machine on which commands can run, as features see it."""

    spec: MachineSpec

    @property
    def provider(self) -> Provider:
        """The machine's provider."""

    @property
    def launch(self) -> str:
        """The launch's id."""

    @property
    def rmw(self) -> str:
        """The launch's middleware."""

    def run(self, command: Command, /, *, timeout: float) -> str:
        """
        Run a command there; return its output. Ctrl-C ends it on the way up.

        :param timeout: seconds; on the way down a machine that does not answer gets few.
        :raises FogError: the command failed, the machine does not answer, or the launch ends.
        """

    def step(self, name: str) -> contextlib.AbstractContextManager[list[str]]:
        """Report a step around a block, which may append details to the list that it gets."""


class RunningMachine(ReachedMachine, Protocol):
    """
    A machine that is up, as features see it.

    :ivar machine: as the provider reported it.
    :ivar shell: copies files; for commands there is ``run``.
    :ivar interface: its end of the launch's VPN.
    :ivar environment: the variables of its nodes.
    """

    machine: Machine
    shell: Shell
    interface: VpnInterface
    environment: Mapping[str, str]

    @property
    def vpn_address(self) -> str:
        """The machine's address in the VPN."""

    @property
    def dds_file(self) -> str:
        """Path of the middleware's configuration there, which ``environment`` names."""

    @property
    def directory(self) -> str:
        """The agent's folder on the machine."""

    @property
    def lost(self) -> str:
        """Why the machine is gone or must not be used any more, '' while it is there."""

    def warn(self, text: str, remedy: str) -> None:
        """Warn the user, with what to do about it on a line of its own."""

    def note(self, name: str, text: str) -> None:
        """Let ``ros2 fog`` show a text while the launch runs: see ``Feature.notes``."""

    def makes(self, name: str, /) -> None:
        """Record that ``clean_up`` of the feature with this name undoes what it makes next."""

    def open_port(self, port: int, sources: Sequence[str]) -> tuple[str, int]:
        """
        Open a TCP port of the machine until the machine ends; return (host, port) to connect to.

        :param sources: networks (CIDR) that may connect.
        :raises FogError: the provider cannot open the port.
        """

    def watch(
        self, name: str, argv: Sequence[str], interval: float, then: Callable[[str], None],
    ) -> None:
        """
        Run a program there, as root, every ``interval`` seconds until it exits with 0.

        :param name: of the watch, not 'vpn' or 'notice'; an earlier one of this name ends.
        :param argv: its files are ``/run/INTERFACE.watch*``, which go with the VPN.
        :param then: called once, in a thread that must not wait, with what it has printed: text of
            a machine, which is not trusted. An error that it raises is reported.
        """

    def give_up(self, reason: str) -> None:
        """
        Let the launch end machine and nodes as ``on_exit`` says, and go on without them.

        Only once its nodes start: raise a FogError before that.
        """

    def lose_after(self, seconds: float) -> None:
        """Count a silent machine as lost after this time, even if its provider says it runs."""

    def bear_silence(self, seconds: float) -> None:
        """Count a machine as lost only after this time without a word of it and its provider."""


class VpnLink(Protocol):
    """
    The robot's end of the VPN to a machine, and what it takes to carry packets between the two.

    :ivar port: UDP port of the machine's end there; ``robot_port`` is the port of the robot's.
    :ivar direct: ``host:port`` of the machine's end, None if the machine dials the robot.
    """

    spec: MachineSpec
    port: int
    robot_port: int
    direct: Optional[str]

    def open_outside(self) -> Endpoint:
        """
        Let the robot in without the VPN; return how a shell reaches the machine then.

        :raises FogError: the firewall can't be changed.
        """

    def close_outside(self) -> None:
        """
        Let nobody in without the VPN any more, where the launch closes machines; may be repeated.

        :raises FogError: the firewall can't be changed, or the VPN does not work.
        """

    @property
    def silence(self) -> Optional[float]:
        """Seconds since the last answer through the VPN, None before the first."""

    def dial(self, relay: str, carried: str) -> None:
        """
        Let the robot's end send to a relay on this computer from now on.

        :param relay: ``host:port``, '' for the machine's end itself.
        :param carried: what carries the packets in place of UDP, for ``ros2 fog status``.
        :raises FogError: the robot's end can't be changed.
        """

    def step(self, name: str) -> contextlib.AbstractContextManager[list[str]]:
        """Report a step around a block, which may append details to the list that it gets."""

    def advise(self, remedy: str) -> None:
        """Add to the error for a machine from which nothing has come back."""


class LaunchedMachine(Protocol):
    """A machine that some node of a launch needs, as features see it."""

    @property
    def interrupted(self) -> bool:
        """Whether the provider reclaims the machine, which may still run, or it is gone."""

    @property
    def renamed(self) -> Mapping[str, str]:
        """New names of topics and services of its nodes, by the names that others have too."""

    @property
    def sent(self) -> Sequence[NodeSpec]:
        """Its nodes that have started, or are about to, as they were before ``starting``."""


class RunningLaunch(Protocol):
    """
    A launch with machines, as features see it.

    :ivar ended: set when the launch ends.
    """

    ended: threading.Event

    @property
    def context(self) -> Any:
        """The ``launch.LaunchContext`` in which launch runs."""

    @property
    def machines(self) -> Mapping[str, LaunchedMachine]:
        """The machines that nodes need so far, by name."""

    @property
    def costs(self) -> Sequence[Cost]:
        """The costs of all machines, as ``Feature.lifetime`` gets them."""

    @property
    def folder(self) -> Path:
        """The launch's folder on the robot, which ends with the launch."""

    @property
    def interface(self) -> str:
        """The name of the robot's VPN interface."""

    @property
    def environment(self) -> Mapping[str, str]:
        """The variables of the robot's nodes."""

    def name_of(self, machine: Any) -> Optional[str]:
        """Return the name of a machine, or of a name's substitutions, None for the robot."""

    def spec(self, name: str) -> MachineSpec:
        """
        Return a machine as the launch file requests it.

        :raises ConfigurationError: there is none of this name.
        """

    def other_vpn(self, name: str) -> Optional[OtherVpn]:
        """Return the VPN of another robot in which a machine is, None for the launch's."""


@dataclasses.dataclass(frozen=True)
class Program:
    """
    A program that runs beside the nodes of a launch, and does not keep the launch alive.

    :param machine: where it runs, None for the robot.
    :param after: on the robot, the machine for which the program waits, None for none.
    """

    node: NodeSpec
    machine: Optional[str]
    after: Optional[str] = None


class LaunchPart:
    """
    What a feature does in one launch; by default, each method does nothing.

    All methods but ``watch`` are called on launch's event loop, and must not wait. ``items`` are
    those of the feature's ``node_list``, ``own`` is what ``resolve`` returned for them.
    """

    def check(self, items: Sequence[Any]) -> None:
        """
        Check items as far as they are known before substitutions are resolved.

        :raises FogError: one is wrong.
        """

    def everywhere(self, items: Sequence[Any], namespace: str) -> None:
        """
        Take items for every machine of the launch.

        :raises FogError: one is wrong.
        """

    def resolve(self, items: Sequence[Any], namespace: str) -> Any:
        """
        Return the items of a node or a group with their substitutions resolved.

        :param namespace: of relative names.
        :raises FogError: one is wrong.
        """
        return ()

    def beside(self, own: Any, machine: Optional[str]) -> Iterable[Program]:
        """
        Return the programs that a process needs and no earlier process did; called for each.

        :param own: () if the process has no items of its own.
        :param machine: where the process runs, None for the robot.
        :raises FogError: they can't run together.
        """
        return ()

    def starting(self, machine: str, nodes: Sequence[NodeSpec]) -> Sequence[NodeSpec]:
        """Return nodes as they start on a machine."""
        return nodes

    def names(self, machine: str) -> Mapping[str, str]:
        """Return new names of topics for components that load on a machine now."""
        return {}

    def topics(self, own: Any) -> Mapping[str, bool]:
        """Return the topics that have other names on machines, and whether the robot has each."""
        return {}

    def moved(self, machine: str) -> tuple[Sequence[str], Iterable[Program]]:
        """Return ids of nodes to end, and new programs: a machine's nodes move to the robot."""
        return (), ()

    def watch(self) -> None:
        """
        Watch the launch in a thread, from its first machines on until ``ended`` is set.

        The launch waits for its return before it ends, and reports an error.
        """


class Feature:
    """
    A feature of machines; by default, each method does nothing.

    ``options`` is a static method whose parameters are the feature's keywords in launch files, on
    the command line and in files of defaults. Their annotations give the kinds of the values, and
    each has a default. It raises ConfigurationError for a wrong value, and returns what the other
    methods get as ``own``. ``node_options`` is the same for nodes of machines; its values are in
    ``NodeSpec.features``.

    Each method is called on a new object: nothing in ``self`` reaches a later one. ``check_node``,
    ``beside``, ``in_launch`` and ``session`` are called on launch's event loop and must not wait,
    the others in threads of several machines.
    """

    options: ClassVar[Callable[..., Any]] = staticmethod(lambda: None)
    node_options: ClassVar[Callable[..., Any]] = staticmethod(lambda: None)
    #: Whether each machine uses the feature, even without its keywords.
    always: ClassVar[bool] = False
    #: Whether its context surrounds those of other features, because it makes folders that these
    #: may use.
    outermost: ClassVar[bool] = False
    #: A keyword of machines that takes a list, and the element of XML and YAML that is one item.
    #: Machines have a method ``add_ELEMENT``, which adds what ``item`` returns for its arguments.
    machine_list: ClassVar[tuple[str, str]] = ('', '')
    item: ClassVar[Callable[..., Any]] = staticmethod(lambda item: item)
    #: Keywords of machines and of nodes that run containers there. Only the machine knows the
    #: programs of such nodes: the launch does not look for them here, nor move them.
    containers: ClassVar[Sequence[str]] = ()
    #: A keyword of nodes, groups and launch descriptions that takes a list, and the element of XML
    #: and YAML that is one item; it parses to a :class:`fogros2.actions.frontend.actions.Item`.
    node_list: ClassVar[tuple[str, str]] = ('', '')

    def in_launch(self, launch: RunningLaunch) -> LaunchPart:
        """Return what the feature does in a launch; called once in each launch with machines."""
        return LaunchPart()

    def check(self, spec: MachineSpec, own: Any) -> None:
        """
        Check a machine that uses the feature before anything is created.

        :raises FogError: the feature can't work there.
        """

    def check_beside(self, spec: MachineSpec, others: Sequence[MachineSpec], own: Any) -> None:
        """
        Check a machine against the launch's other machines before it is created.

        :param spec: with its choices made, as ``others``, which run or will be created.
        :raises FogError: the feature can't work on all of them.
        """

    def lifetime(
        self, spec: MachineSpec, costs: Sequence[Cost], own: Any, *, made: bool,
    ) -> float:
        """
        Return the most seconds that a machine may have from now on.

        Called when its choices are made, when its provider confirms the price, before its first
        node starts, and before the launch creates another machine. A later call may shorten the
        time, and never makes it longer.

        :param costs: of this machine and all others of the launch: those that have ended, those
            that run, and those that will be created.
        :param made: whether the machine exists.
        :raises FogError: there is no such time.
        """
        return spec.lifetime

    def request(self, request: CreateRequest, own: Any) -> CreateRequest:
        """Return the request for a new machine, with what the feature needs of the provider."""
        return request

    def check_node(self, spec: MachineSpec, node: NodeSpec, own: Any) -> None:
        """
        Check a node of a machine that uses the feature, if possible before the machine is created.

        Programs that FogROS2 adds are nodes too, such as encoders. A node that a timer or an event
        starts is checked when the machine runs.

        :raises FogError: the feature can't work with it.
        """

    def beside(self, spec: MachineSpec, own: Any) -> Sequence[Any]:
        """
        Return programs that run on the machine beside its nodes, from its first node on.

        Each is a NodeSpec without files, folders, shell and features, or an action of launch.
        """
        return ()

    def vpn(self, link: VpnLink, own: Any) -> contextlib.AbstractContextManager[Any]:
        """
        Return a context that is entered before the first packet goes through a machine's VPN.

        It is left when the machine's agent has released it. It is not entered for a machine in
        another robot's VPN.
        """
        return contextlib.nullcontext()

    def installing(self, reached: ReachedMachine, nodes: Sequence[NodeSpec], own: Any) -> None:
        """
        Do what takes long, while workspace and modules are installed, in a thread of its own.

        :param nodes: those of the machine that are known by now.
        :raises FogError: the machine can't be used, and ends.
        """

    def machine(self, running: RunningMachine, own: Any) -> contextlib.AbstractContextManager[Any]:
        """
        Return a context that is entered when the machine is up, before its nodes start.

        It is left when the launch gives the machine up, after its nodes and before the machine
        end. On a machine that stays, agent and VPN may have ended by then; the shell works.
        """
        return contextlib.nullcontext()

    def starting(
        self, running: RunningMachine, nodes: Sequence[NodeSpec], own: Any,
    ) -> Sequence[NodeSpec]:
        """
        Return nodes as they start on the machine; called whenever some start there.

        :raises FogError: they can't start, and the launch ends.
        """
        return nodes

    def clean_up(self, launch: str) -> Sequence[Command]:
        """
        Return commands that remove from a machine what a launch has made there.

        They run, perhaps twice, when the launch leaves a machine that stays, and after its death.
        """
        return ()

    def session(self, own: Any) -> Optional[Callable[..., Any]]:
        """
        Return what makes the machine's :class:`~fogros2.runtime.session.Session`, None for that.

        A subclass of Session may move the nodes when the machine ends. Only one installed feature
        may return one, and ``replacement`` of FogROS2 does.
        """
        return None

    #: What it may note of a machine, and the line of ``ros2 fog list`` about that, with ``{name}``
    #: of the machine and ``{note}``; '' for none.
    notes: ClassVar[Mapping[str, str]] = {}
    #: The headings of its table in ``ros2 fog status``; none for no table.
    headings: ClassVar[Sequence[str]] = ()

    def entries(self, record: Record, shell: Shell) -> Sequence[Mapping[str, Any]]:
        """
        Return the rows of the table, as ``ros2 fog status --json`` prints them by its name.

        They are of a machine in a launch's VPN, whether or not its launch file uses the feature.

        :raises FogError: the machine does not tell them.
        """
        return ()

    def figures(self, folder: Path, machine: str) -> Optional[Sequence[Mapping[str, Any]]]:
        """
        Return the rows of the table from files of the robot, None if the machine has to be asked.

        Live views read them several times a second.

        :param folder: the launch's folder, whether or not it exists.
        """
        return None

    def row(self, entry: Mapping[str, Any]) -> Sequence[str]:
        """Return a row of the table for people."""
        return ()

    def status(self, shown: Mapping[str, Any], own: Any) -> Iterable[tuple[str, str]]:
        """
        Return rows, each a name and a text, for ``ros2 fog status`` of a machine.

        :param shown: what ``ros2 fog status --json`` prints.
        """
        return ()


def load(name: str) -> Feature:
    """
    Return a feature.

    :raises ConfigurationError: it is not installed.
    """
    feature: Feature = plugin_system.load(GROUP, name)()
    return feature


def installed() -> dict[str, Feature]:
    """
    Return all features, by name.

    :raises PrerequisiteError: one cannot be loaded.
    """
    return {name: load(name) for name in plugin_system.names(GROUP)}


def loadable(warn: Callable[[str], object] = lambda text: None) -> dict[str, Feature]:
    """Return the features that can be loaded, by name; warn of the others."""
    features = {}
    for name in plugin_system.names(GROUP):
        try:
            features[name] = load(name)
        except Exception as error:  # noqa: BLE001 - a defective feature must not end the others
            warn(f'{name}: {plugin_system.cause(error)}')
    return features


def tables(warn: Callable[[str], object] = lambda text: None) -> dict[str, Feature]:
    """Return the features with a table in ``ros2 fog status``, by name; see ``loadable``."""
    return {name: each for name, each in loadable(warn).items() if each.headings}


def options(name: str, given: Mapping[str, Any], of: str = 'options') -> Any:
    """
    Return a feature's options from the values of its keywords.

    :param of: ``options``, or ``node_options``.
    :raises ConfigurationError: a value is wrong, or this version has no such keyword.
    """
    make = getattr(plugin_system.load(GROUP, name), of)
    for keyword in given.keys() - inspect.signature(make).parameters:
        raise ConfigurationError(f"the installed feature '{name}' has no keyword '{keyword}'",
                                 'install the version that has it')
    return make(**given)


def contained(given: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """
    Return those of a machine's or a node's keywords that run containers, with their values.

    :param given: the values of keywords by feature.
    """
    return {keyword: value for name, values in given.items() for keyword, value in values.items()
            if value and keyword in load(name).containers}


def used(spec: MachineSpec) -> Iterator[tuple[Feature, Any]]:
    """
    Yield the features that a machine uses, with their options.

    :raises ConfigurationError: one is not installed.
    """
    for name in names(spec):
        yield load(name), options(name, spec.features.get(name, {}))


def names(spec: MachineSpec) -> Sequence[str]:
    """
    Return the names of the features that a machine uses, the outermost first.

    :raises ConfigurationError: one is not installed.
    """
    return sorted(dict.fromkeys([*spec.features, *(
        name for name, each in installed().items() if each.always)]),
        key=lambda name: not load(name).outermost)
