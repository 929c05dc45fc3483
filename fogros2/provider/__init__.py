# SPDX-License-Identifier: Apache-2.0
"""
The plugin interface to computers: a cloud, a cluster, a container engine, an existing host.

In reading order: ``machine_types`` (of regions), ``options`` (reading a launch file's options),
this module, then a module or package for each provider: ``ssh``, ``container``, ``kubernetes``,
``vm`` (shared by virtual machines), ``aws``, ``gcp``, ``azure``.
"""

from __future__ import annotations

import abc
from collections.abc import Collection, Iterable, Mapping, Sequence
import contextlib
import dataclasses
from decimal import Decimal
import threading
from typing import ClassVar, Optional

from fogros2.errors import MachineNotFound, NameTaken, ProviderError, Unsupported
from fogros2.model import (
    CreateRequest,
    Machine,
    MachineSpec,
    MachineState,
    OtherVpn,
)
from fogros2.provider.machine_types import Region
from fogros2.waiting import wait_until

#: Tags that the core puts on every resource; the provider's copy of them is the truth.
TAG_NAME = 'fogros2-name'
TAG_ROBOT = 'fogros2-robot'
TAG_LAUNCH = 'fogros2-launch'
TAG_EXPIRES = 'fogros2-expires'
TAG_ON_EXIT = 'fogros2-on-exit'
TAG_DEPENDENCIES = 'fogros2-dependencies'
#: Seconds after which a request without an answer creates no machine any more.
SETTLED = 900.0


@dataclasses.dataclass(frozen=True)
class Capabilities:
    """
    What a provider can do besides the four methods that every provider has.

    A method of :class:`Provider` that needs a capability names it. Without the capability, the
    core does not call the method, or its default does nothing.

    :param shell_kind: name of the shell plugin that reaches its machines.
    :param owned: it creates machines for a launch; False for computers that exist already.
    :param account: a launch has a login there that another robot gave and may take away, and
        nothing beside it; ``other_vpn`` and ``join`` lead to the machine.
    :param containers: a container engine can run on its machines, without an option for it.
    :param ports: other networks reach a port of the machine after ``open_port``.
    :param firewall: ``allow`` and ``robot_address`` decide who reaches a machine. The launch then
        closes the SSH port as soon as the VPN works.
    :param one_time_host_key: other programs may have read the host key that ``describe`` reports.
        The launch then has the machine generate another one, and calls ``pin``.
    :param stop: ``stop`` and ``start`` keep a machine's disk.
    :param choices: ``resolve`` may change a spec.
    :param adopt: ``adopt`` changes how an existing machine ends.
    :param regions: it has regions: ``region_names``, ``regions``, ``search_in``.
    :param places: it stands for other providers: ``places`` names them for a spec.
    :param agent_directory: folder on the machine of the agent that ``create`` starts at boot; ''
        if the launch starts the agent over the first connection.
    :param agent_program: path on the machine of that agent's program.
    :param agent_sent: the launch sends that program over the first connection, and the machine
        waits for it from its boot on.
    :param share_folders: folders on the machine by which its programs meet those of other machines
        on its host: its own, and the folder of all; empty if the provider has none.
    :param application_port: TCP port on the machine's loopback where ``create`` serves the
        request's application, 0 if it serves none.
    :param preemption_notice: command that the agent runs as root every few seconds. Exit status 0
        means that the provider is about to reclaim the machine; the output has reason and time.
    :param keeps_volumes: it has disks or folders that outlive machines, ``with_volumes`` of a
        request, and methods that attach and list them.
    """

    shell_kind: str = 'ssh'
    owned: bool = True
    account: bool = False
    containers: bool = True
    ports: bool = True
    firewall: bool = False
    one_time_host_key: bool = False
    stop: bool = False
    choices: bool = False
    adopt: bool = False
    regions: bool = False
    places: bool = False
    agent_directory: str = ''
    agent_program: str = ''
    agent_sent: bool = False
    share_folders: tuple[str, ...] = ()
    application_port: int = 0
    preemption_notice: tuple[str, ...] = ()
    keeps_volumes: bool = False


@dataclasses.dataclass(frozen=True)
class Attached:
    """
    How a volume appears on a machine; without both, ``create`` has mounted it at its path.

    :param devices: paths of its block device, of which one appears.
    :param folder: of a computer that exists already; '~/' stands for the login user's home.
    """

    devices: tuple[str, ...] = ()
    folder: str = ''


def made_without(machine: str, volume: str) -> NameTaken:
    """Return the error for a kept machine that was created without a volume."""
    return NameTaken(f"the machine '{machine}' of an earlier launch has no volume '{volume}'",
                     f'give the machine another name=, or: ros2 fog delete {machine}')


def known_by_records() -> bool:
    """Return False for :meth:`Provider.configured`: records alone know the machines."""
    return False


class Provider(abc.ABC):
    """
    A source of machines.

    A subclass implements ``create``, ``describe``, ``find`` and ``destroy``; each other method
    has a default. Several threads call the methods at the same time. An SDK's error is raised as
    a FogError with ``raise ... from``. Only the provider reads a machine's id.
    """

    name: ClassVar[str]
    capabilities: ClassVar[Capabilities] = Capabilities()
    #: Maximum pause in seconds between two requests of ``reachable``.
    poll_interval: ClassVar[float] = 3.0
    #: Set when the launch or the verb that uses this provider ends. Long calls, such as
    #: ``create`` and ``reachable``, then raise Cancelled; ``destroy`` and ``stop`` continue.
    cancel: Optional[threading.Event] = None

    # -- before a machine exists ----------------------------------------------------------------

    @classmethod
    def configured(cls) -> bool:
        """
        Return whether this provider is set up here (credentials, a configuration file).

        The command line skips a provider that is not, unless a record or an option names it. The
        method reads only files and variables and loads no SDK. A provider that is slow to import
        is also an entry point of the group ``fogros2.configured``, which is called instead.
        """
        return True

    def answers(self) -> str:
        """
        Make the smallest request, and return a few words for people (account, version).

        :raises FogError: the provider does not answer, or refuses the credentials.
        """
        count = sum(1 for _ in self.find({}))
        return f'answers, {count} machine{"" if count == 1 else "s"}'

    def check(self, spec: MachineSpec) -> None:
        """
        Check everything that ``create`` needs, quickly and at no cost.

        :raises ConfigurationError: an option is unknown or has a wrong value.
        :raises PrerequisiteError: this computer lacks something.
        """

    def check_here(self, spec: MachineSpec) -> None:
        """
        Check what needs no more rights than the user has, before the launch asks for any.

        These are the options, programs, credentials, and whether a host answers. The launch waits
        a few seconds for it, then continues; ``check`` follows.

        :raises FogError: the first problem that was found, with its remedy.
        """
        self.check(spec)

    def check_containers(self, spec: MachineSpec) -> None:
        """
        Check that a container engine can run on a machine with this spec.

        :raises Unsupported: it cannot.
        """
        if not self.capabilities.containers:
            raise Unsupported(
                f"'{spec.name}' can't run containers: a machine of the provider '{self.name}' "
                'lacks the rights that an engine needs',
                'run them on an EC2 instance, an SSH host or a container machine')

    def resolve(self, spec: MachineSpec) -> MachineSpec:
        """
        Resolve open choices of a spec, such as 'nearest' and 'cheapest' (``choices``).

        Called once, after ``check`` and before ``create``; it may make requests at no cost.

        :raises FogError: nothing fits, or the provider does not answer.
        """
        return spec

    def places(self, spec: MachineSpec) -> list[tuple[str, MachineSpec]]:
        """
        Return specs to try while there is no capacity, each with words for people (``places``).

        Called before ``resolve``; each spec names the provider that creates the machine.

        :raises FogError: nothing fits, or no provider answers.
        """
        return []

    def other_vpn(self, spec: MachineSpec) -> Optional[OtherVpn]:
        """
        Return the VPN of another robot in which a machine is; None: it joins the launch's.

        :raises ConfigurationError: an option has a wrong value.
        """
        return None

    def join(
        self, spec: MachineSpec, rmw: str, domain: int, environment: Mapping[str, str],
    ) -> contextlib.AbstractContextManager[object]:
        """
        Return a context in which this computer is in the VPN of ``other_vpn``.

        It is entered before the first node that needs it, and left after the last.

        :param rmw: the launch's RMW_IMPLEMENTATION; ``domain`` its ROS_DOMAIN_ID.
        :raises FogError: the launch and the VPN do not fit, or it cannot be joined.
        """
        return contextlib.nullcontext()

    def choices(self, spec: MachineSpec, chosen: MachineSpec) -> list[str]:
        """Describe for people what ``resolve`` has changed."""
        return [f'{key} ' + (' or '.join(map(str, value)) if isinstance(value, (list, tuple))
                             else str(value))
                for key, value in sorted(chosen.options.items())
                if spec.options.get(key) != value]

    def architecture(self, spec: MachineSpec) -> str:
        """
        Return the processor architecture of a machine with a resolved spec.

        :returns: as ``uname -m`` prints it (``x86_64``, ``aarch64``), '' if it is not known yet.
        :raises FogError: the provider does not answer.
        """
        return ''

    def shared_folders(self, spec: MachineSpec) -> Sequence[str]:
        """Return the folders of this computer that the machine also has."""
        return ()

    def has_own_packages(self, spec: MachineSpec) -> bool:
        """Return whether the machine may have ROS packages that this computer does not have."""
        return False

    def cost_per_hour(self, spec: MachineSpec) -> Optional[Decimal]:
        """
        Return the price of a machine with a resolved spec in US dollars, None if unknown.

        A launch pays nothing for a computer that exists already.
        """
        return None if self.capabilities.owned else Decimal(0)

    # -- a machine's life -----------------------------------------------------------------------

    @abc.abstractmethod
    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """
        Request a machine and return its id at once, without waiting until it runs.

        A second call with the same ``request.token`` returns the same machine.

        :param spec: with the capability ``choices``, a result of :meth:`resolve`.
        :raises NameTaken: a machine of this name exists, created with another token.
        :raises ProviderError: refused; nothing is left behind. ``refused`` of the error is False
            if a machine may exist in spite of it.
        """

    @abc.abstractmethod
    def describe(self, machine_id: str) -> Machine:
        """
        Return the current state of a machine.

        ``endpoint`` is set, with the host key to pin, as soon as a connection can be tried. From
        then on ``vpn_host`` is the address of the machine's VPN port. If nobody outside can reach
        that port, ``robot_host`` is the robot's current address, to which the machine connects.
        ``end_command`` is required for a machine that was created for a launch: the agent runs it
        as root when the robot is gone, and it must end the billing.

        :raises MachineNotFound: the machine does not exist (any more).
        """

    def reclaims(self, machine_id: str) -> bool:
        """
        Return whether the provider itself reports that it reclaims a machine, or has done so.

        The launch asks after a machine's notice, which a node there may have forged.

        :raises FogError: the provider does not answer.
        """
        try:
            state = self.describe(machine_id).state
        except MachineNotFound:
            return True
        return state not in (MachineState.PENDING, MachineState.RUNNING)

    @abc.abstractmethod
    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        """
        Yield the machines that have all of ``tags``, in any state but deleted.

        An empty mapping finds every machine of FogROS2.

        :raises Unsupported: the provider keeps no tags.
        """

    def search_for(self, specs: Iterable[MachineSpec]) -> None:
        """Let ``find`` also search where machines with these specs are, if specs name places."""

    @abc.abstractmethod
    def destroy(self, machine_id: str) -> None:
        """
        Delete a machine and everything created for it; return when all of it is gone.

        Idempotent: an id that is unknown or already deleted is no error.
        """

    def capabilities_of(self, machine: Machine) -> Capabilities:
        """Return the capabilities of one machine, if they depend on it (a spot instance)."""
        return self.capabilities

    def adopt(self, machine_id: str, spec: MachineSpec, tags: Mapping[str, str]) -> None:
        """
        Give a kept or stopped machine to this launch, before it is started or connected to.

        A provider that stores on the machine how it ends replaces that (``adopt``).

        :param spec: this launch's; ``on_exit`` is how the machine ends from now on.
        :param tags: the core's tags that change.
        """

    def reachable(
        self, machine_id: str, *, name: str, timeout: float, known: Optional[Machine] = None,
    ) -> Machine:
        """
        Wait until a machine runs and a connection can be tried; return it.

        A provider whose API can be watched overrides this method instead of polling.

        :param known: what ``describe`` has just returned, which saves the first look; a provider
            that looks at more may ignore it.
        :raises ProviderError: the machine ended, or cannot start, with the provider's reason.
        :raises DeadlineExceeded: after ``timeout`` seconds.
        :raises Cancelled: ``cancel`` was set.
        """
        seen = [known] if known is not None else []

        def look() -> Optional[Machine]:
            machine = seen.pop() if seen else self.describe(machine_id)
            if machine.state in (MachineState.DELETED, MachineState.STOPPING):
                raise ProviderError(f"the machine '{name}' ended while it was coming up",
                                    "the provider's own log says why")
            return machine if machine.state is MachineState.RUNNING and machine.endpoint else None

        return wait_until(look, timeout=timeout, cancel=self.cancel, longest=self.poll_interval,
                          what=f"the machine '{name}' to run")

    def stop(self, machine_id: str) -> None:
        """
        Stop a machine so that it can be started again with its disk (``stop``).

        :raises Unsupported: this machine cannot be stopped.
        """
        raise Unsupported(f"provider '{self.name}' can't stop a machine",
                          "use on_exit='keep' or 'delete'")

    def start(self, machine_id: str) -> None:
        """
        Start a stopped machine again (``stop``).

        :raises Unsupported: the provider cannot.
        """
        raise Unsupported(f"provider '{self.name}' can't start a machine")

    def tidy(self, dead: Collection[str] = ()) -> list[str]:
        """
        Delete the remains of machines that ended by themselves; describe them for people.

        Resources of a machine that exists, or that is being created, stay.

        :param dead: tokens of requests (``CreateRequest``) whose launches have died.
        """
        return []

    def may_create(self, token: str, age: float) -> bool:
        """
        Return whether a request for a machine that got no answer may still create one.

        :param token: of the request (``CreateRequest``).
        :param age: seconds since the launch stopped waiting for the answer.
        """
        return self.capabilities.owned and age < SETTLED

    # -- its network ----------------------------------------------------------------------------

    def robot_address(self) -> str:
        """
        Return the address (CIDR) from which machines see this computer (``firewall``).

        :raises Unsupported: the provider has no firewall.
        """
        raise Unsupported(f"provider '{self.name}' has no firewall")

    def allow(self, machine_id: str, port: int, sources: Sequence[str]) -> None:
        """
        Let only ``sources`` (CIDR) reach a TCP port of a machine (``firewall``).

        :param sources: none closes the port, even if ``cancel`` is set.
        :raises Unsupported: the provider has no firewall.
        """
        raise Unsupported(f"provider '{self.name}' has no firewall")

    def ssh_networks(self, spec: MachineSpec) -> Sequence[str]:
        """Return the networks (CIDR) that always reach the SSH port, beside the robot."""
        return ()

    def open_port(
        self, machine: Machine, port: int, sources: Sequence[str],
    ) -> tuple[str, int]:
        """
        Let only ``sources`` (CIDR) reach a TCP port of a machine; return its host and port there.

        Without sources, close the port. A provider without a firewall opens nothing: the server
        on that port checks its clients.
        """
        if self.capabilities.firewall:
            self.allow(machine.id, port, sources)
        return machine.vpn_host, port

    def dialled_at(
        self, machine: Machine, port: int, host: Optional[str] = None,
    ) -> tuple[str, int]:
        """
        Open a machine's VPN port to other computers than the robot; return its host and port.

        The host is '' for an address of the robot.

        The firewalls of clouds admit everybody to that port: WireGuard answers only its peers.

        :param port: the UDP port on the machine.
        :param host: the user's choice of the address.
        :raises Unsupported: no other computer can dial the machine.
        """
        if not machine.vpn_host:
            raise Unsupported(
                f"'{machine.name}' dials the robot, so no other computer can dial it",
                'expose its VPN port: see the options of its provider')
        return host or machine.vpn_host, machine.vpn_port or port

    def pin(self, machine_id: str, host_key: str) -> None:
        """
        Store the host key (OpenSSH form) that the machine has generated (``one_time_host_key``).

        From now on ``describe`` reports it, on any computer.

        :raises Unsupported: the provider's host key needs no replacement.
        """
        raise Unsupported(f"provider '{self.name}' has no one-time host keys")

    # -- regions --------------------------------------------------------------------------------

    @classmethod
    def region_names(cls) -> Sequence[str]:
        """Return the names of the regions without any request, for completion (``regions``)."""
        return ()

    def regions(self, names: Sequence[str] = (), *, every: bool = False) -> list[Region]:
        """
        Return regions with the round trip from here, the nearest first (``regions``).

        :param names: only these.
        :param every: include regions that an account has to enable first.
        :raises ConfigurationError: a name is unknown.
        :raises Unsupported: the provider has no regions.
        """
        raise Unsupported(f"provider '{self.name}' has no regions")

    def nearest(self, names: Sequence[str] = ()) -> str:
        """
        Return the region with the fastest response (``regions``).

        :param names: the candidates; none for all.
        :raises ProviderError: no region answers.
        """
        return self.regions(names)[0].region

    def search_in(self, regions: Sequence[str]) -> None:
        """
        Let ``find`` and ``tidy`` search these regions (``regions``).

        :param regions: names; 'all' stands for every region of the account.
        """
