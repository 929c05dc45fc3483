# SPDX-License-Identifier: Apache-2.0
"""Machines of other robots, by an invitation; a launch has an account of its own there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import contextlib
import dataclasses
import os
from typing import ClassVar

from fogros2.errors import DdsError, MachineNotFound, Unsupported
from fogros2.model import CreateRequest, Endpoint, Machine, MachineSpec, MachineState, OtherVpn
from fogros2.provider import Capabilities, Provider
from fogros2.provider.options import parsed
from fogros2.store import launch_process, other_vpn, Store, this_process
from fogros2_features.guests import network, program
from fogros2_features.guests.invitation import DOOR_KEY, Invitation, own_key, unseal

_SCHEME = 'joined:'


@dataclasses.dataclass(frozen=True)
class Options:
    """
    Options of another robot's machine.

    :param invitation: what ``ros2 fog invite`` printed for this computer.
    """

    invitation: str = ''


class JoinedProvider(Provider):
    """Machines of other robots, whose launches admit this computer."""

    name: ClassVar[str] = 'joined'
    capabilities: ClassVar[Capabilities] = Capabilities(
        shell_kind='guest', owned=False, account=True, containers=False, ports=False)
    poll_interval: ClassVar[float] = 0.1

    def check(self, spec: MachineSpec) -> None:
        """Check that the invitation is for this computer, and valid."""
        self._unsealed(spec)

    def _text(self, spec: MachineSpec) -> str:
        return parsed(Options, spec.options, 'a joined machine').invitation

    def _unsealed(self, spec: MachineSpec) -> Invitation:
        return unseal(self._text(spec), own_key(Store()))

    def other_vpn(self, spec: MachineSpec) -> OtherVpn:
        """Return the VPN that the invitation leads to."""
        # not above: it imports what launches do
        from fogros2_features.guests import membership
        return membership.other_vpn(self._unsealed(spec), Store())

    @contextlib.contextmanager
    def join(
        self, spec: MachineSpec, rmw: str, domain: int, environment: Mapping[str, str],
    ) -> Iterator[None]:
        """Be in that VPN, unless ``ros2 fog join`` has joined it already."""
        from fogros2.deploy.robot import clear
        from fogros2_features.guests import membership
        invitation = self._unsealed(spec)
        if (invitation.rmw, invitation.domain) != (rmw, domain):
            raise DdsError(
                f"'{spec.name}' has RMW_IMPLEMENTATION={invitation.rmw} and ROS_DOMAIN_ID="
                f'{invitation.domain}, this launch {rmw} and {domain}', 'launch with the same')
        # a launch that was killed has left it
        by_hand = membership.is_up(invitation) and membership.is_held(
            Store().root / 'launches' / invitation.number)
        folder = membership.join(self._text(spec), Store(), environment, owner=this_process())
        try:
            yield
        finally:
            with membership.changing(Store()):
                # others may have joined meanwhile
                if not by_hand and launch_process(folder)[0] == os.getpid():
                    clear(folder)

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Return the id of the machine, which the launch has joined."""
        return f'{_SCHEME}{self._unsealed(spec).number}:{spec.name}'

    def describe(self, machine_id: str) -> Machine:
        """Return the machine while this computer has joined it."""
        number, _, name = machine_id.removeprefix(_SCHEME).partition(':')
        folder = Store().root / 'launches' / number
        other = other_vpn(folder) if number.isalnum() else None
        if other is None:
            raise MachineNotFound(f"this computer has left the machine '{name}'")
        return Machine(
            machine_id, name, self.name, MachineState.RUNNING, owned=False,
            region=other.machine.name, endpoint=Endpoint(
                'guest', other.interface.address, network.PORT,
                program.account(other.interface.name, other.own.address),
                key_file=str(folder / DOOR_KEY)))

    def capabilities_of(self, machine: Machine) -> Capabilities:
        """Return the capabilities with the place of the agent, which each guest has."""
        assert machine.endpoint is not None
        home = program.HOMES / machine.endpoint.user
        return dataclasses.replace(self.capabilities, agent_directory=f'{home}/agent',
                                   agent_program=f'{home}/agent.py')

    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        """Raise Unsupported: this computer has no rights to another robot's tags."""
        raise Unsupported('a joined machine keeps no tags of this robot')

    def destroy(self, machine_id: str) -> None:
        """Do nothing: the launch did not create the machine."""
