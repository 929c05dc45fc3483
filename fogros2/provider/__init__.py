# SPDX-License-Identifier: Apache-2.0
"""The seam to those who have computers: AWS, Kubernetes, a container engine, a host by SSH."""

from __future__ import annotations

import abc
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
import threading
from typing import ClassVar, Optional

from fogros2.errors import ProviderError, Unsupported
from fogros2.model import CreateRequest, Image, Machine, MachineSpec, MachineState
from fogros2.waiting import wait_until

#: Tags that the core puts on everything; the provider's copy of them is the truth.
TAG_NAME = 'fogros2-name'
TAG_ROBOT = 'fogros2-robot'
TAG_LAUNCH = 'fogros2-launch'
TAG_EXPIRES = 'fogros2-expires'
TAG_ON_EXIT = 'fogros2-on-exit'
TAG_DEPENDENCIES = 'fogros2-dependencies'


class Provider(abc.ABC):
    """
    Somebody who has machines.

    Subclasses write four methods, synchronously; they are called from several threads at once.
    Their SDK's errors become FogErrors with ``raise ... from``. A machine's id is theirs alone.
    """

    name: ClassVar[str]
    #: Kind of shell that its machines are reached by, so that it can be loaded beforehand.
    shell_kind: ClassVar[str] = 'ssh'
    #: Folder of the agent that ``create`` starts at boot, and its program on the machine; ''
    #: where it starts none, and the deployment does as soon as it has a shell.
    agent_directory: ClassVar[str] = ''
    agent_program: ClassVar[str] = ''
    #: Whether its computers are made for a launch, not somebody's that exist already.
    owned: ClassVar[bool] = True
    #: Whether a container engine can run on its machines, unasked.
    runs_containers: ClassVar[bool] = True
    #: Port of the machine's loopback at which ``create`` serves the request's application, 0 where
    #: it serves none.
    application_port: ClassVar[int] = 0
    #: Seconds between two looks at a machine that comes up slowly, at the most.
    look_interval: ClassVar[float] = 3.0
    #: Whether ``allow`` decides who reaches a machine; the launch then closes the SSH port as soon
    #: as the VPN carries the connection.
    firewall: ClassVar[bool] = False
    #: Whether the host key that ``describe`` tells was handed over at boot, where others may read
    #: it: the launch then has the machine make another at once, and calls ``pin``.
    one_time_host_key: ClassVar[bool] = False
    #: Command line that an agent runs as root every few seconds; once it exits with 0 the machine
    #: is about to be taken away, and what it printed says why and when. Empty: no such notice.
    notice: ClassVar[tuple[str, ...]] = ()
    #: Set when the launch that this provider works for is to end: long calls on the way up give
    #: up with Cancelled. Calls that begin later belong to the way down.
    cancel: Optional[threading.Event] = None

    @classmethod
    def configured(cls) -> bool:
        """
        Return whether somebody has set this provider up here (credentials, a configuration file).

        Asked by the command line before anything is loaded: one that isn't set up is left out of
        what goes to all providers, unless a record or an option names it. Files and variables
        alone; no SDK. A provider that takes long to import has it as an entry point of the group
        ``fogros2.configured`` as well, which is asked in its place.
        """
        return True

    def answers(self) -> str:
        """
        Ask for as little as possible, and return a few words for people (account, version).

        :raises FogError: it can't be reached, or doesn't take our credentials.
        """
        count = sum(1 for _ in self.find({}))
        return f'answers, {count} machine{"" if count == 1 else "s"}'

    def check(self, spec: MachineSpec) -> None:
        """
        Look for everything ``create`` will need, quickly and at no cost.

        :raises ConfigurationError: an option is unknown or its value is wrong.
        :raises PrerequisiteError: this computer lacks something.
        """

    def check_containers(self, spec: MachineSpec) -> None:
        """
        Look whether a container engine can run on a machine of this spec.

        :raises Unsupported: it can't.
        """
        if not self.runs_containers:
            raise Unsupported(
                f"'{spec.name}' can't run containers: a machine of the provider '{self.name}' "
                "hasn't the rights that an engine takes",
                'run them on an EC2 instance, a computer that is reached by SSH or in a '
                'container machine')

    def resolve(self, spec: MachineSpec) -> MachineSpec:
        """
        Return the spec with every open choice made ('nearest' region, 'cheapest' type).

        May ask the provider, at no cost; called once, after ``check`` and before ``create``.

        :raises FogError: nothing there is fits, or nobody answers.
        """
        return spec

    def choices(self, asked: MachineSpec, chosen: MachineSpec) -> list[str]:
        """Return in words, for people, what ``resolve`` has made of a spec."""
        return [f'{key} {" or ".join(map(str, value)) if _is_list(value) else value}'
                for key, value in sorted(chosen.options.items())
                if asked.options.get(key) != value]

    def architecture(self, spec: MachineSpec) -> str:
        """
        Return the processor architecture that a machine of a resolved spec will have.

        :returns: as ``uname -m`` has it (``x86_64``, ``aarch64``), '' where it isn't known yet.
        :raises FogError: nobody answers.
        """
        return ''

    def shown(self, spec: MachineSpec) -> Sequence[str]:
        """Return the folders of this computer that a machine of a spec has too."""
        return ()

    def cost_per_hour(self, spec: MachineSpec) -> Optional[Decimal]:
        """Return what a machine of a resolved spec will cost (US dollars), None if unknown."""
        return None

    @abc.abstractmethod
    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """
        Ask for a machine and return its id at once, without waiting for it to run.

        Called again with the same ``request.token`` it returns the same machine.

        :raises ProviderError: refused; nothing is left behind then.
        """

    def adopt(self, machine_id: str, spec: MachineSpec, tags: Mapping[str, str]) -> None:
        """
        Let a machine that an earlier launch kept or stopped be this launch's.

        Called before it is started or connected to. A provider whose machines say by themselves
        until when they live, and how they end, writes that anew.

        :param spec: this launch's; ``on_exit`` says how the machine ends from now on.
        :param tags: those of the core's that are others by now.
        """

    def notice_for(self, machine: Machine) -> tuple[str, ...]:
        """Return ``notice`` for a machine that can be taken away, () for one that isn't."""
        return self.notice

    @abc.abstractmethod
    def describe(self, machine_id: str) -> Machine:
        """
        Return what is known of a machine now.

        ``shell`` is set, with the host key to pin, as soon as a connection can be tried. By then
        ``vpn_host`` says where the robot dials the machine's VPN port; where nobody outside can,
        ``robot_host`` says where the machine dials the robot, and where the robot is by now each
        time that this is asked.

        :raises MachineNotFound: it doesn't exist (any more).
        """

    @abc.abstractmethod
    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        """
        Yield the machines that carry all of ``tags``, in any state but deleted.

        An empty mapping finds every machine of FogROS2's.

        :raises Unsupported: the provider keeps no tags.
        """

    @abc.abstractmethod
    def destroy(self, machine_id: str) -> None:
        """
        End a machine and everything made for it, and return when it is gone.

        Idempotent: an id that is unknown, or gone already, is no error.
        """

    def tidy(self) -> list[str]:
        """
        Delete what machines that ended by themselves left behind, and say what, for people.

        What belongs to a machine that exists, or is being made, stays.
        """
        return []

    def stop(self, machine_id: str) -> None:
        """
        Stop a machine so that it can be started again with its disk as it is.

        :raises Unsupported: the provider can't.
        """
        raise Unsupported(f"provider '{self.name}' can't stop a machine",
                          "use on_exit='keep' or 'delete'")

    def start(self, machine_id: str) -> None:
        """
        Start a stopped machine again.

        :raises Unsupported: the provider can't.
        """
        raise Unsupported(f"provider '{self.name}' can't start a machine")

    def reachable(
        self, machine_id: str, *, name: str, timeout: float, cancel: threading.Event,
    ) -> Machine:
        """
        Wait until a machine runs and a connection can be tried, and return it.

        A provider whose API can be watched writes this anew, so that nobody asks again and again.

        :raises ProviderError: it ended meanwhile, or can't come up, with the provider's reason.
        :raises DeadlineExceeded: after ``timeout`` seconds.
        :raises Cancelled: ``cancel`` was set.
        """
        def look() -> Optional[Machine]:
            machine = self.describe(machine_id)
            if machine.state in (MachineState.DELETED, MachineState.STOPPING):
                raise ProviderError(f"the machine '{name}' ended while it was coming up",
                                    "the provider's own log says why")
            return machine if machine.state is MachineState.RUNNING and machine.shell else None

        return wait_until(look, timeout=timeout, cancel=cancel, longest=self.look_interval,
                          what=f"the machine '{name}' to run")

    def robot_address(self) -> str:
        """
        Return the address (CIDR) that this computer's connections to machines come from.

        :raises Unsupported: the provider has no firewall.
        """
        raise Unsupported(f"provider '{self.name}' has no firewall")

    def allow(self, machine_id: str, port: int, sources: Sequence[str]) -> None:
        """
        Let ``sources`` (CIDR) reach a TCP port of a machine, they alone; none of them closes it.

        :raises Unsupported: the provider has no firewall.
        """
        raise Unsupported(f"provider '{self.name}' has no firewall")

    def publish(
        self, machine: Machine, port: int, sources: Sequence[str],
    ) -> tuple[str, int]:
        """
        Let ``sources`` (CIDR) reach a TCP port of a machine, they alone, and return where they do.

        None of them closes it, and ends what was made for it. Whatever listens there has to look
        itself who comes: a provider without a firewall of its own, as here, opens nothing.
        """
        if self.firewall:
            self.allow(machine.id, port, sources)
        return machine.vpn_host, port

    def pin(self, machine_id: str, host_key: str) -> None:
        """
        Remember the host key (OpenSSH form) that the machine has made for itself.

        ``describe`` tells it from now on, on any computer.

        :raises Unsupported: the provider hands no key over at boot.
        """
        raise Unsupported(f"provider '{self.name}' hands no host key over at boot")

    def bake(self, machine_id: str, name: str, dependencies: str) -> str:
        """
        Make an image of a machine and return its id at once; ``images`` tells when it is ready.

        :param dependencies: see :class:`~fogros2.model.Image`.
        :raises Unsupported: the provider keeps no images.
        """
        raise Unsupported(f"provider '{self.name}' keeps no images of machines")

    def images(self) -> Iterable[Image]:
        """
        Yield the images that were made of machines.

        :raises Unsupported: the provider keeps none.
        """
        raise Unsupported(f"provider '{self.name}' keeps no images of machines")

    def delete_image(self, image_id: str) -> None:
        """
        Delete an image and the disks' copies behind it; idempotent.

        :raises Unsupported: the provider keeps none.
        """
        raise Unsupported(f"provider '{self.name}' keeps no images of machines")


def _is_list(value: object) -> bool:
    return isinstance(value, (list, tuple))
