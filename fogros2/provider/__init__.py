# SPDX-License-Identifier: Apache-2.0
"""The seam to those who have computers: AWS, Kubernetes, a container engine, a host by SSH."""

from __future__ import annotations

import abc
from collections.abc import Iterable, Mapping
from typing import ClassVar

from fogros2.errors import Unsupported
from fogros2.model import CreateRequest, Machine, MachineSpec

#: Tags that the core puts on everything; the provider's copy of them is the truth.
TAG_NAME = 'fogros2-name'
TAG_ROBOT = 'fogros2-robot'
TAG_LAUNCH = 'fogros2-launch'
TAG_EXPIRES = 'fogros2-expires'
TAG_ON_EXIT = 'fogros2-on-exit'


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

    def check(self, spec: MachineSpec) -> None:
        """
        Look for everything ``create`` will need, quickly and at no cost.

        :raises ConfigurationError: an option is unknown or its value is wrong.
        :raises PrerequisiteError: this computer lacks something.
        """

    @abc.abstractmethod
    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """
        Ask for a machine and return its id at once, without waiting for it to run.

        Called again with the same ``request.token`` it returns the same machine.

        :raises ProviderError: refused; nothing is left behind then.
        """

    @abc.abstractmethod
    def describe(self, machine_id: str) -> Machine:
        """
        Return what is known of a machine now.

        ``shell`` is set, with the host key to pin, as soon as a connection can be tried.

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

    def allow(self, machine_id: str, address: str) -> None:
        """
        Let the robot's new public ``address`` (CIDR) reach the machine's SSH port, it alone.

        :raises Unsupported: the provider has no firewall.
        """
        raise Unsupported(f"provider '{self.name}' has no firewall")
