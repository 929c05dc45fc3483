# SPDX-License-Identifier: Apache-2.0
"""Step 5: the machine's end of the VPN."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import dataclasses
from typing import Optional

from fogros2 import plan
from fogros2.agent_client import AgentClient
from fogros2.deploy.guarding import Guard
from fogros2.deploy.job import Job
from fogros2.deploy.robot_vpn import VpnMember
from fogros2.errors import CommandError, FogError, VpnError
from fogros2.model import Command, Machine, Peer, VpnInterface
from fogros2.report import step
from fogros2.shell import Shell
from fogros2.vpn import addresses

#: Sends a packet to an address and port, from which the peer learns this end's endpoint.
_KNOCK = """\
import socket, sys
socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'', (sys.argv[1], int(sys.argv[2])))
"""


class Joining:
    """Add one machine to the launch's VPN, and remove it."""

    def __init__(self, job: Job, guard: Guard) -> None:
        self._job = job
        self._guard = guard
        self._member: Optional[VpnMember] = None

    def interface(self) -> VpnInterface:
        """Return the machine's interface; record it before it is created."""
        job = self._job
        robot = job.launch.robot_vpn().interface
        port = job.record.vpn.port if job.record.vpn else plan.machine_port(job.launch.id)
        interface = plan.machine_interface(
            job.launch.id, robot.network, job.launch.index(job.name), port,
            f'{self._guard.directory}/vpn.key')
        job.save(vpn=interface)
        return interface

    def fit(self, interface: VpnInterface, routes: Sequence[str]) -> VpnInterface:
        """
        Adapt the interface to a machine with these routes (IPv4, CIDR).

        The robot chose the launch's subnet before the machine existed, and its nodes may already
        run, so the subnet stays. If one of the machine's networks overlaps the subnet, the machine
        routes only its peers' addresses into the VPN.
        """
        if addresses.overlapping(interface.network, routes):
            interface = dataclasses.replace(interface, host_routes=True)
            self._job.save(vpn=interface)
        return interface

    def join(
        self, machine: Machine, shell: Shell, agent: AgentClient, interface: VpnInterface,
    ) -> VpnMember:
        """
        Bring the machine's interface up, and add the machine to the peers of the others.

        :raises VpnError: the port is in use, or neither end can reach the other.
        """
        job = self._job
        with job.step('VPN') as detail:
            robot = job.launch.robot_vpn()
            vpn = robot.vpn
            job.undoing('VPN', lambda: self._leave(shell, agent, interface))
            job.undoing('VPN', lambda: robot.remove(job.name))
            public_key = job.on(shell, [vpn.keys(interface)]).strip()
            place = plan.place(
                machine, Peer(job.name, public_key, interface.address), interface.port,
                robot.interface.port)

            def keep(peers: Sequence[Peer]) -> None:
                """Make the agent repair the machine's VPN when its program ends."""
                agent.request(
                    'keep', timeout=job.timeouts.agent, what='vpn', interval=1.0,
                    alive=list(vpn.alive(interface).argv),
                    repair=[list(c.argv) for c in vpn.repair(interface, peers)],
                    down=[list(c.argv) for c in vpn.down(interface)])

            member = VpnMember(
                place, interface, lambda commands: job.on(shell, commands), keep)
            try:
                # configure the end that is dialled first: the dialling end retries only after 5 s
                if place.robot_endpoint is not None:
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
                if 'in use already:' in error.result.stderr:
                    raise VpnError(
                        f"'{job.name}' uses addresses of the VPN's network itself: "
                        f'{error.result.stderr.strip().splitlines()[-1]}',
                        'launch again: each launch takes another network') from error
                raise
            robot.spread(member)
            self._member = member
            detail.append(interface.address)
            if place.robot_endpoint is not None:
                detail.append(f'dials {place.robot_endpoint}')
            return member

    def redial(self, machine: Machine) -> None:
        """
        Update the robot's endpoint on a machine that dials the robot, if it has changed.

        :param machine: what the provider reports.
        """
        member, job = self._member, self._job
        if member is None or member.place.robot_endpoint is None or not machine.robot_host:
            return
        robot = job.launch.robot_vpn()
        endpoint = plan.endpoint(machine.robot_host, robot.interface.port)
        if endpoint != member.place.robot_endpoint:
            with contextlib.suppress(FogError), step(
                    job.launch.report, job.name, 'VPN, from where the robot is now',
                    fatal=False) as detail:
                member.redial(robot, endpoint)
                detail.append(f'dials {endpoint}')
                if job.shell is not None:
                    # its next packet shows the robot the way back; a keepalive would take 25 s
                    job.on(job.shell, [Command(
                        ('python3', '-IS', '-c', _KNOCK, robot.interface.address,
                         str(plan.HEARTBEAT_PORT)), what='greet the robot')])

    def _leave(self, shell: Shell, agent: AgentClient, interface: VpnInterface) -> None:
        job = self._job
        if job.survives:
            # otherwise the agent would repair the interface
            job.undone('nodes', lambda: self._guard.release(agent))
            job.tidy(shell, job.launch.robot_vpn().vpn.down(interface))
