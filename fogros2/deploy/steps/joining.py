# SPDX-License-Identifier: Apache-2.0
"""Bring up the machine's end of the VPN."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import dataclasses
from typing import Optional

from fogros2 import plan
from fogros2.deploy.context import Context
from fogros2.deploy.machine_job import MachineJob, Step
from fogros2.deploy.robot_vpn import VpnMember
from fogros2.deploy.steps.connecting import Connection
from fogros2.deploy.undo import VPN, vpn_down
from fogros2.errors import CommandError, FogError, VpnError
from fogros2.host.inspection import HostFacts
from fogros2.model import Command, host_port, Machine, Peer, VpnInterface
from fogros2.report import step
from fogros2.store import Made
from fogros2.vpn import addresses

#: Sends a packet to an address and port, from which the peer learns this end's endpoint.
_KNOCK = """\
import socket, sys
socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'', (sys.argv[1], int(sys.argv[2])))
"""


class Joining(Step):
    """Add one machine to the launch's VPN, and remove it."""

    def __init__(self, context: Context, job: MachineJob) -> None:
        super().__init__(context, job)
        self._member: Optional[VpnMember] = None
        #: The interface of an earlier launch, if it has stayed.
        self._former: Optional[VpnInterface] = None

    def choose_interface(self) -> None:
        """Choose the machine's interface; record it before it is created."""
        context, job = self._context, self._job
        if Made(VPN) in job.record.made:
            self._former = job.record.vpn
        record = job.record
        port = record.vpn.port if record.vpn else \
            record.vpn_port or plan.machine_port(context.launch_id)
        job.interface = plan.machine_interface(
            context.launch_id, context.vpn.interface.network, context.index, port,
            f'{job.directory}/vpn.key',
            '' if context.capabilities.owned else f'{job.directory}/agent.pid')
        job.save(vpn=job.interface)

    def avoid(self, facts: HostFacts) -> None:
        """
        Adapt the interface to the machine's networks.

        The robot chose the launch's subnet before the machine existed, and its nodes may already
        run, so the subnet stays. If one of the machine's networks overlaps the subnet, the machine
        routes only its peers' addresses into the VPN.

        :raises ConfigurationError: another machine of the launch is the same computer.
        """
        job = self._job
        self._context.vpn.place(job.name, facts.network)
        if addresses.overlapping(job.interface.network, facts.routes):
            job.interface = dataclasses.replace(job.interface, host_routes=True)
            job.save(vpn=job.interface)

    def join(self) -> None:
        """
        Bring the machine's interface up, and add the machine to the peers of the others.

        :raises VpnError: the port is in use, or neither end can reach the other.
        """
        job, interface, robot = self._job, self._job.interface, self._context.vpn
        with job.step('VPN') as detail:
            job.push(VPN)
            job.undoing(VPN, lambda: robot.remove(job.name))
            if self._former is not None:
                # others still use it, and its port is needed
                job.run(*robot.vpn.down(self._former))
            public_key = job.run(robot.vpn.keys(interface)).strip()
            route = plan.route(
                job.machine, Peer(job.name, public_key, interface.address), interface.port,
                robot.interface.port)
            member = VpnMember(
                route, interface, lambda commands: job.run(*commands), self._health_check)
            try:
                # configure the end that is dialled first: the dialling end retries only after 5 s
                if route.robot_endpoint is not None:
                    robot.admit(member)
                    member.up(robot)
                else:
                    member.up(robot)
                    robot.admit(member)
            except CommandError as error:
                if 'Address already in use' in error.result.stderr:
                    raise VpnError(
                        f"UDP port {interface.port} of '{job.name}' is in use already",
                        'launch again: each launch takes another port') from error
                if 'nft: ' in error.result.stderr:
                    raise VpnError(
                        f"'{job.name}' can't filter the DDS of strangers: "
                        f'{error.result.stderr.strip().splitlines()[-1]}',
                        'use an image or a kernel with nftables (nf_tables)') from error
                if 'in use already:' in error.result.stderr:
                    raise VpnError(
                        f"'{job.name}' already uses addresses of the VPN's network: "
                        f'{error.result.stderr.strip().splitlines()[-1]}',
                        'launch again: each launch takes another network') from error
                raise
            robot.spread(member)
            self._member = member
            detail.append(interface.address)
            if route.robot_endpoint is not None:
                detail.append(f'dials {route.robot_endpoint}')
        job.save(public_key=public_key)

    def _health_check(self, peers: Sequence[Peer]) -> None:
        """Make the agent repair the machine's VPN when its program ends."""
        job, vpn = self._job, self._context.vpn.vpn
        job.agent.request(
            'watch', timeout=self._context.timeouts.agent, what='vpn', interval=1.0,
            argv=list(vpn.health_check(job.interface).argv),
            repair=[list(c.argv) for c in vpn.repair(job.interface, peers)],
            down=[list(c.argv) for c in vpn_down(job.record)])

    def restore(self) -> None:
        """Let an agent that was started again check the machine's VPN."""
        if self._member is not None:
            self._member.restore(self._context.vpn)

    def links(self, connection: Connection) -> Sequence[RobotLink]:
        """Return the link to the machine, for features that may carry its packets."""
        return [RobotLink(self._context, self._job, self._member, connection)] \
            if self._member else []

    def redial(self, machine: Machine) -> None:
        """
        Update the robot's endpoint on a machine that dials the robot, if it has changed.

        :param machine: what the provider reports.
        """
        member, job, robot = self._member, self._job, self._context.vpn
        if member is None or member.route.robot_endpoint is None or not machine.robot_host:
            return
        endpoint = host_port(machine.robot_host, robot.interface.port)
        if endpoint != member.route.robot_endpoint:
            with contextlib.suppress(FogError), step(
                    self._context.report, job.name, 'VPN, from where the robot is now',
                    fatal=False) as detail:
                member.redial(robot, endpoint)
                detail.append(f'dials {endpoint}')
                # its next packet shows the robot the way back; a keepalive would take 25 s
                job.run(Command(
                    ('python3', '-IS', '-c', _KNOCK, robot.interface.address,
                     str(plan.HEARTBEAT_PORT)), what='greet the robot'))


class RobotLink(Step):
    """The robot's end of the VPN to a machine; see :class:`fogros2.feature.VpnLink`."""

    def __init__(
        self, context: Context, job: MachineJob, member: VpnMember, connection: Connection,
    ) -> None:
        super().__init__(context, job)
        self._member = member
        self.spec = job.spec
        self.port = job.interface.port
        self.robot_port = context.vpn.interface.port
        self.direct = member.route.peer.endpoint
        self.step = job.step
        self.open_outside, self.close_outside = connection.open_outside, connection.close_outside

    @property
    def silence(self) -> Optional[float]:
        """Seconds since the last answer through the VPN, None before the first."""
        heartbeat = getattr(self._job, 'heartbeat', None)
        return heartbeat.age if heartbeat is not None else None

    def advise(self, remedy: str) -> None:
        """Add to the error for a machine from which nothing has come back."""
        if remedy not in self._job.advice:
            self._job.advice.append(remedy)

    def dial(self, relay: str, carried: str) -> None:
        """Let the robot's end send to a relay on this computer, '' for the machine itself."""
        self._context.vpn.dial(self._member, relay, anew=self.silence is None)
        self._job.save(carried=carried)


class Joined(Joining):
    """Use a machine in the VPN of another robot, which the launch has joined."""

    def choose_interface(self) -> None:
        """Take the interface that the other robot has made."""
        other, job = self._context.other_vpn, self._job
        assert other is not None
        job.interface = other.interface
        job.heartbeats = (other.heartbeats, other.own.address)

    def avoid(self, facts: HostFacts) -> None:
        """Do nothing: the interface exists."""

    def join(self) -> None:
        """Do nothing: the launch has joined before its first node."""
