# SPDX-License-Identifier: Apache-2.0
"""
What a package can add to machines: keywords, a check, and steps with their undo.

A feature is an entry point in the group ``fogros2.feature``. doc/developers/features.md shows how
to write one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
from decimal import Decimal
from typing import Any, ClassVar, Optional, Protocol

from fogros2 import plugin_system
from fogros2.model import Command, Machine, MachineSpec, NodeSpec, VpnInterface
from fogros2.shell import Shell
from fogros2.store import Record

#: The group of entry points.
GROUP = 'fogros2.feature'


class RunningMachine(Protocol):
    """
    A machine that is up, as features see it.

    :ivar machine: as the provider reported it.
    :ivar shell: copies files; for commands there is ``run``.
    :ivar interface: its end of the launch's VPN, and ``vpn_address`` the address there.
    """

    spec: MachineSpec
    machine: Machine
    shell: Shell
    interface: VpnInterface
    vpn_address: str

    @property
    def directory(self) -> str:
        """The agent's folder on the machine."""

    @property
    def lost(self) -> str:
        """Why the machine is gone or must not be used any more, '' while it is there."""

    @property
    def cost(self) -> tuple[Optional[Decimal], Decimal]:
        """US dollars per hour, None if unknown, and what its launch has spent so far."""

    def run(self, command: Command, *, timeout: float) -> str:
        """
        Run a command there; return its output. Ctrl-C ends it on the way up.

        :param timeout: seconds; on the way down a machine that does not answer gets few.
        :raises FogError: the command failed, the machine does not answer, or the launch ends.
        """

    def step(self, name: str) -> contextlib.AbstractContextManager[list[str]]:
        """Report a step around a block, which may append details to the list that it gets."""

    def warn(self, text: str, remedy: str) -> None:
        """Warn the user, with what to do about it on a line of its own."""

    def watch(
        self, name: str, argv: Sequence[str], interval: float, then: Callable[[str], None],
    ) -> None:
        """
        Run a program there, as root, every ``interval`` seconds until it exits with 0.

        :param name: of the watch; an earlier one of this name ends.
        :param argv: its files are ``/run/INTERFACE.watch*``, which go with the VPN.
        :param then: called once, in a thread that must not wait, with what it has printed: text of
            a machine, which is not trusted.
        """

    def give_up(self, reason: str) -> None:
        """Let the launch end machine and nodes as ``on_exit`` says, and go on without them."""


class Feature:
    """
    A feature of machines; by default, each method does nothing.

    ``options`` is a static method whose parameters are the feature's keywords in launch files, on
    the command line and in files of defaults. Their annotations give the kinds of the values, and
    each has a default. It raises ConfigurationError for a wrong value, and returns what the other
    methods get as ``own``.
    """

    options: ClassVar[Callable[..., Any]] = staticmethod(lambda: None)

    def check(self, spec: MachineSpec, own: Any) -> None:
        """
        Check a machine that uses the feature before anything is created.

        :raises FogError: the feature can't work there.
        """

    def lifetime(
        self, spec: MachineSpec, price: Optional[Decimal], spent: Decimal, own: Any, *,
        made: bool,
    ) -> float:
        """
        Return the most seconds that a machine may have from now on.

        Called when its choices are made, when its provider confirms the price, and before its
        first node starts.

        :param price: US dollars per hour, None if the provider tells none.
        :param spent: what the launch has spent on machines of this name so far, in US dollars.
        :param made: whether the machine exists.
        :raises FogError: there is no such time.
        """
        return spec.lifetime

    def check_node(self, spec: MachineSpec, node: NodeSpec, own: Any) -> None:
        """
        Check a node of a machine that uses the feature before the machine is created.

        :raises FogError: the feature can't work with it.
        """

    def beside(self, spec: MachineSpec, own: Any) -> Sequence[NodeSpec]:
        """Return programs that run on the machine beside its nodes, from its first node on."""
        return ()

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

    #: The headings of its table in ``ros2 fog status``; none for no table.
    headings: ClassVar[Sequence[str]] = ()

    def entries(self, record: Record, shell: Shell) -> Sequence[Mapping[str, Any]]:
        """
        Return the rows of the table, as ``ros2 fog status --json`` prints them by its name.

        They are of a machine in a launch's VPN, whether or not its launch file uses the feature.

        :raises FogError: the machine does not tell them.
        """
        return ()

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


def with_tables() -> dict[str, Feature]:
    """
    Return the features that have a table, by name.

    :raises PrerequisiteError: a feature cannot be loaded.
    """
    return {name: each for name in plugin_system.names(GROUP) if (each := load(name)).headings}


def options(name: str, given: Mapping[str, Any]) -> Any:
    """
    Return a feature's options from the values of its keywords.

    :raises ConfigurationError: a value is wrong.
    """
    return plugin_system.load(GROUP, name).options(**given)


def used(spec: MachineSpec) -> Iterator[tuple[Feature, Any]]:
    """
    Yield the features that a machine uses, with their options.

    :raises ConfigurationError: one is not installed.
    """
    for name, given in spec.features.items():
        yield load(name), options(name, given)
