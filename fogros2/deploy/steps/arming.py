# SPDX-License-Identifier: Apache-2.0
"""Install the agent on a machine, configure it, and send it heartbeats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import functools
import hashlib
import secrets
from typing import Any, Optional

from fogros2 import model, plan
from fogros2.agent_client import agent_program, AgentClient, Heartbeat, interval_for
from fogros2.deploy.machine_job import AGENT_FOLDER, Step
from fogros2.deploy.robot import run
from fogros2.deploy.undo import first_config, NODES, WATCHDOG
from fogros2.errors import (
    AgentAbsent,
    AgentError,
    Cancelled,
    CommandError,
    FogError,
    VpnError,
)
from fogros2.model import Command, VpnInterface
from fogros2.vpn import addresses
from fogros2.waiting import Periodic, wait_until

# Install and start the agent in one round trip. Standard input is the configuration in one line,
# then the agent's source; sh reads the line byte by byte, so that cat gets the rest.
# $1 folder of all agents, $2 this agent's folder, $3 program, $4 our configuration, $5 login user.
_INSTALL = """\
umask 077
install -d -m 755 "$1"
install -d -m 700 -o "$5" "$2"
aside=$3.$$.new
trap 'rm -f -- "$4" "$aside"' EXIT
IFS= read -r line
printf '%s\\n' "$line" >"$4"
cat >"$aside"
chmod 700 "$aside"
chown "$5" "$aside"
mv -f -- "$aside" "$3"
python3 -IS "$3" serve --detach --config "$4"
"""

# Send the agent's program: $1 path, $2 its bytes. Standard input is the agent's source.
_SEND = """\
umask 077
cat >"$1.new"
# a lost connection ends standard input too
[ "$(wc -c <"$1.new")" -eq "$2" ]
chmod 755 "$1.new"
mv -f -- "$1.new" "$1"
"""
# To a machine whose boot script waits for it; keep an earlier one.
_SEND_FIRST = f'[ -e "$1" ] && exit\n{_SEND}'
# In place of another version, whose process is $3; the machine starts the agent again.
_REPLACE = f'{_SEND}kill -KILL "$3" || true\n'


class Arming(Step):
    """The agent of one machine, seen from the robot."""

    # -- on the way up --------------------------------------------------------------------------

    def arm(self) -> None:
        """
        Make sure that an agent watches the machine; connect to the agent.

        :raises AgentError: another launch uses the machine.
        """
        context, job, program = self._context, self._job, self._job.capabilities.agent_program
        endpoint = job.machine.endpoint
        config = {
            **plan.agent_config(
                job.spec, context.launch_id, job.directory, job.machine.end_command),
            'user': endpoint.user if endpoint else '',
            # fixed before any node starts, even if there is none
            'notice': self._notice,
            # the launch keeps in touch from now on: by re-arming the agent, then by heartbeats
            'boot_timeout': job.spec.robot_timeout}
        with job.step('watchdog'):
            # the agent may take the request while its reply is lost
            job.save(owners=(*job.formers[:9], context.launch_id))
            agent = None
            if not program:
                program = f'{job.directory}/agent.py'
                if job.run(Command.script(
                        f'[ ! -S {job.directory}/agent.sock ] || echo there', sudo=True,
                        what='look for an agent')).strip():
                    # of a launch that died, or of another robot, which keeps it
                    agent = self._claim(program, config)
                job.push(WATCHDOG, agent=job.directory, agent_program=program)
                if agent is None:
                    self._install(program, config)
            else:
                job.save(agent=job.directory, agent_program=program)
                if job.capabilities.agent_sent:
                    source = agent_program().encode()
                    job.run(Command(
                        ('sh', '-ec', _SEND_FIRST, 'sh', program, str(len(source))), sudo=True,
                        input=source, what='send the agent'))
            agent = agent or self._awaited(program, config)
            job.undo.callback(agent.close)
            can = job.capabilities
            if job.formers and can.owned and can.agent_program and self._renew(agent, program):
                agent = self._awaited(program, config)
                job.undo.callback(agent.close)
            job.agent = agent
            # a busy machine gets more time to answer, as long as it sends anything
            job.probes.insert(0, lambda seconds: agent.request(
                'ping', timeout=3 * seconds, silent=seconds))
            job.push(NODES, owners=(context.launch_id,))
            job.rearming = Periodic('fog-rearm', job.spec.robot_timeout / 4, self._rearm)
            job.undo.callback(job.rearming.close)

    def _awaited(self, program: str, config: Mapping[str, Any]) -> AgentClient:
        """Wait for the machine's agent, and claim it."""
        return wait_until(
            lambda: self._claim(program, config), timeout=self._context.timeouts.agent,
            cancel=self._job.cancel, what=f"the agent of '{self._job.name}'")

    def _renew(self, agent: AgentClient, program: str) -> bool:
        """
        End the agent of a kept machine if it is of another version than this robot's.

        The launch has claimed the agent, so no nodes run. The machine starts the robot's version.

        :return: whether the launch has to claim the new agent.
        """
        job, timeout, source = self._job, self._context.timeouts.agent, agent_program().encode()
        digest = job.run(Command(
            ('sha256sum', program), sudo=True, what='look at the version of the agent'))
        if digest.split()[:1] == [hashlib.sha256(source).hexdigest()]:
            return False
        # its successor must see a kept machine, not one of a launch whose agent died
        agent.request('release', timeout=timeout, launch=self._context.launch_id)
        pid = int(agent.request('status', timeout=timeout)['pid'])
        agent.close()
        job.run(Command(
            ('sh', '-ec', _REPLACE, 'sh', program, str(len(source)), str(pid)), sudo=True,
            input=source, what='replace the agent'))
        return True

    @property
    def _notice(self) -> list[str]:
        return list(
            self._context.provider.capabilities_of(self._job.machine).preemption_notice)

    def watch_notice(self) -> None:
        """Let an agent that was started again watch for the preemption notice."""
        job = self._job
        job.agent.request(
            'configure', timeout=self._context.timeouts.agent, launch=self._context.launch_id,
            again=True, notice=self._notice,
            # which this restarts
            lifetime=max(1.0, job.time_left))

    def _rearm(self) -> None:
        # a later call may get through; the current step reports a lasting failure
        with contextlib.suppress(FogError):
            self._job.agent.request('configure', launch=self._context.launch_id, again=True)

    def _install(self, program: str, config: Mapping[str, Any]) -> None:
        job = self._job
        line = model.to_json(config).encode()
        assert b'\n' not in line
        try:
            job.run(Command(
                ('sh', '-ec', _INSTALL, 'sh', AGENT_FOLDER, job.directory, program,
                 first_config(job.record), str(config['user'])),
                sudo=True, input=line + b'\n' + agent_program().encode(),
                what='start the agent'))
        except CommandError as error:
            if '"kind":"running"' in error.result.stdout:
                raise AgentError(
                    f"another robot has just taken the machine '{job.name}' of this computer",
                    'give the machine another name=') from error
            raise

    def _claim(self, program: str, config: Mapping[str, Any]) -> Optional[AgentClient]:
        """
        Connect to the machine's agent and claim it; return None if there is no agent yet.

        :raises AgentError: another launch uses the machine.
        """
        job = self._job
        # no cancel: the way down needs the connection too, and each request has a time-out
        agent = AgentClient(job.shell, job.directory, agent_path=program)
        try:
            answer = self._configure(agent, config)
        except FogError as error:
            agent.close()
            if isinstance(error, AgentAbsent):
                return None  # the SSH server may be up before the agent
            raise
        job.first_event = int(answer.get('next', 1))
        return agent

    def _configure(self, agent: AgentClient, config: Mapping[str, Any]) -> Mapping[str, Any]:
        # the record shows that the former launches have ended; the agent may not know that yet
        configure = functools.partial(
            agent.request, 'configure', timeout=self._context.timeouts.agent, **config)
        *newer, first = reversed(self._job.formers or ('',))
        for former in newer:
            try:
                return configure(force=former)
            except AgentAbsent:
                raise
            except AgentError:
                pass  # it may never have heard of that launch
        return configure(force=first)

    # -- with nodes -----------------------------------------------------------------------------

    def start_heartbeat(self, setup: Sequence[str], environment: Mapping[str, str]) -> None:
        """
        Send the agent the environment of nodes, and start the heartbeat.

        :param setup: setup files that nodes need.
        :raises VpnError: no heartbeat was answered through the VPN.
        """
        context, job, address = self._context, self._job, self._job.interface.address
        key, (port, peer) = secrets.token_hex(32), job.heartbeats
        job.limit(made=True)
        job.restart_lifetime(job.spec.lifetime)
        try:
            job.agent.request(
                'configure', timeout=context.timeouts.agent, launch=context.launch_id, again=True,
                lifetime=job.spec.lifetime,
                heartbeat={'bind': address, 'port': port, 'peer': peer, 'key': key},
                environment={'FOGROS2_VPN_ADDRESS': address, **environment}, setup=list(setup))
        except AgentError as error:
            if 'in use' in str(error):
                raise VpnError(
                    f"UDP port {port} of '{job.name}' is in use already",
                    f"end what listens there: ss -lunp 'sport = :{port}'"
                ) from error
            raise
        job.heartbeat = Heartbeat(
            address, port, key, interval=interval_for(job.spec.robot_timeout))
        job.undo.callback(job.heartbeat.close)
        try:
            wait_until(
                lambda: job.heartbeat.round_trip is not None, timeout=context.timeouts.vpn,
                cancel=job.cancel, what='an answer through the VPN', longest=0.05)
        except FogError as error:
            if isinstance(error, Cancelled):
                raise
            raise VpnError(
                f"nothing comes back from '{job.name}' through the VPN",
                '; '.join([self._cause(), *job.advice])) from error
        if job.rearming is not None:
            job.rearming.close()

    def _cause(self) -> str:
        """Return why nothing may come back through the VPN."""
        context, job, robot = self._context, self._job, self._context.vpn
        handshake, route = False, ''
        with contextlib.suppress(FogError):
            status = run([robot.vpn.status(robot.interface)], timeout=context.timeouts.command)
            peer = robot.vpn.parse_status(status).get(job.record.public_key)
            handshake = peer is not None and peer['handshake'] > 0
            route = run([route_to(job.interface.address)], timeout=context.timeouts.command)
        return cause(job.name, job.interface, robot.interface, handshake=handshake, route=route,
                     pool=addresses.pool_from(context.environment))


def route_to(address: str) -> Command:
    """Return the command that prints the interface of packets to an address."""
    return Command(('ip', '-4', 'route', 'get', address), what='look at the route')


def cause(
    name: str, machine: VpnInterface, robot: VpnInterface, *, handshake: bool, route: str,
    pool: str,
) -> str:
    """
    Return why nothing may come back from a machine through the VPN, and the remedy.

    :param handshake: whether WireGuard's packets come back.
    :param route: output of :func:`route_to`, '' if unknown.
    :param pool: of the VPN's networks (CIDR).
    """
    if not handshake:
        return f'is UDP port {machine.port} open on the way there?'
    if route and f' dev {robot.name} ' not in route:
        return ('a routing rule of this computer (as of another VPN) sends the packets elsewhere: '
                f'{route.splitlines()[0].strip()}; try: sudo ip rule add pref 100 to {pool} '
                'lookup main')
    return (f"WireGuard's own packets come back, so a firewall of '{name}' may drop what comes "
            'through the VPN; for ufw, run there: sudo ufw allow in on fog+')
