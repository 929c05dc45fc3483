# SPDX-License-Identifier: Apache-2.0
"""Steps 8 to 11: install the agent on a machine, configure it and send it heartbeats."""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import functools
import threading
from typing import Any, Optional

from fogros2 import bootstrap, model, plan
from fogros2.agent_client import agent_source, AgentClient, Heartbeat
from fogros2.deploy.job import Job, SILENT
from fogros2.errors import (
    AgentAbsent,
    AgentError,
    Cancelled,
    CommandError,
    DeadlineExceeded,
    FogError,
    VpnError,
)
from fogros2.model import Command, Machine, VpnInterface
from fogros2.shell import Shell
from fogros2.waiting import wait_until

AGENT_FOLDER = '/run/fogros2'
#: Poll interval in seconds for the provider's preemption notice.
NOTICE_INTERVAL = 5.0

# Install and start the agent in one round trip. Standard input is the configuration in one line,
# then the agent's source; sh reads the line byte by byte, so that cat gets the rest.
# $1 folder of all agents, $2 this agent's folder, $3 program, $4 our configuration, $5 login user.
_INSTALL = """\
umask 077
install -d -m 755 "$1"
install -d -m 700 -o "$5" "$2"
aside=$3.$$.new
trap 'rm -f -- "$4" "$aside"' EXIT
IFS= read -r told
printf '%s\\n' "$told" >"$4"
cat >"$aside"
chmod 700 "$aside"
chown "$5" "$aside"
mv -f -- "$aside" "$3"
python3 -IS "$3" serve --detach --config "$4"
"""

# Remove the agent. A released agent has exited; an agent that was never reached still runs.
# Another robot's agent stays: its configuration names its launch.
# $1 folder, $2 launch, $3 our configuration.
_REMOVE = """\
running() { [ "$(head -c 6 /proc/$pid/cmdline 2>/dev/null)" = python ]; }
rm -f -- "$3"
if read -r pid 2>/dev/null <"$1/agent.pid" && running; then
    grep -qsF "\\"launch\\": \\"$2\\"" "$1/config.json" || exit 0
    kill -s TERM $pid; n=0
    while running && [ $n -lt 100 ]; do sleep 0.1; n=$((n + 1)); done
else
    # another robot may be about to start one
    for each in "$1"/start-*.json; do [ ! -e "$each" ] || exit 0; done
fi
rm -rf -- "$1"
# the folder of all agents goes with the last one
rmdir -- "${1%/*}" 2>/dev/null || :
"""


class Guard:
    """The agent of one machine, seen from the robot."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._released = False
        self._rearming: Optional[_Rearming] = None
        #: Number of the first event that belongs to this launch.
        self.first_event = 1

    @property
    def directory(self) -> str:
        """The agent's folder on the machine."""
        return self._job.provider.agent_directory or f'{AGENT_FOLDER}/{self._job.name}'

    # -- on the way up --------------------------------------------------------------------------

    def arm(self, machine: Machine, shell: Shell) -> AgentClient:
        """
        Make sure that an agent guards the machine; connect to the agent.

        :raises AgentError: another launch uses the machine.
        """
        job, program = self._job, self._job.provider.agent_program
        config = plan.agent_config(job.spec, job.launch.id, self.directory, machine.end_command)
        config['user'] = machine.shell.user if machine.shell else ''
        # from now on the launch keeps in touch: first by re-arming the agent, then by heartbeats
        config['boot_timeout'] = job.spec.robot_timeout
        with job.step('guard'):
            agent = None
            if not program:
                program = f'{self.directory}/agent.py'
                if job.on(shell, [Command.script(
                        f'[ ! -S {self.directory}/agent.sock ] || echo there', sudo=True,
                        what='look for an agent')]).strip():
                    # of a launch that died, or of another robot, which keeps it
                    agent = self._reach(shell, program, config)
                job.undoing('guard', functools.partial(self._remove, shell))
                if agent is None:
                    self._install(shell, program, config)
            job.save(agent=self.directory, agent_program=program)
            agent = agent or wait_until(
                lambda: self._reach(shell, program, config),
                timeout=job.timeouts.agent, cancel=job.cancel,
                what=f"the agent of '{job.name}'")
            job.undo.callback(agent.close)
            # a busy machine gets more time to answer, as long as it sends anything
            job.ask = lambda seconds: agent.request('ping', timeout=3 * seconds, silent=seconds)
            self.undo_nodes(agent)
            self._rearming = _Rearming(agent, job.launch.id, job.spec.robot_timeout / 4)
            job.undo.callback(self._rearming.close)
            notice = job.provider.notice_for(machine)
            if notice:
                agent.request('watch', timeout=job.timeouts.agent, what='notice',
                              argv=list(notice), interval=NOTICE_INTERVAL)
            return agent

    def _install(self, shell: Shell, program: str, config: Mapping[str, Any]) -> None:
        job = self._job
        told = model.to_json(config).encode()
        assert b'\n' not in told
        try:
            job.on(shell, [Command(
                ('sh', '-ec', _INSTALL, 'sh', AGENT_FOLDER, self.directory, program,
                 self._first_config, str(config['user'])),
                sudo=True, input=told + b'\n' + agent_source().read_bytes(),
                what='start the agent')])
        except CommandError as error:
            if '"kind":"running"' in error.result.stdout:
                raise AgentError(
                    f"another robot has just taken the machine '{job.name}' of this computer",
                    'give the machine another name=') from error
            raise

    @property
    def _first_config(self) -> str:
        return f'{self.directory}/start-{self._job.launch.id}.json'

    def _reach(
        self, shell: Shell, program: str, config: Mapping[str, Any],
    ) -> Optional[AgentClient]:
        """
        Connect to the machine's agent and claim it; return None if there is no agent yet.

        :raises AgentError: another launch uses the machine.
        """
        # no cancel: the way down needs the connection too, and each request has a time-out
        agent = AgentClient(shell, self.directory, agent_path=program)
        try:
            # the record shows that the former launch has ended; its agent may not know that yet
            answer = agent.request('configure', timeout=self._job.timeouts.agent,
                                   force=self._job.former, **config)
        except FogError as error:
            agent.close()
            if isinstance(error, AgentAbsent):
                return None  # the SSH server may be up before the agent
            raise
        self.first_event = int(answer.get('next', 1))
        return agent

    def _remove(self, shell: Shell) -> None:
        job = self._job
        if job.survives:
            job.tidy(shell, [Command(
                ('sh', '-ec', _REMOVE, 'sh', self.directory, job.launch.id, self._first_config),
                sudo=True, what='remove the agent')])

    # -- with nodes -----------------------------------------------------------------------------

    def start(
        self, agent: AgentClient, interface: VpnInterface, ros: bootstrap.RosInstall,
        dds: Mapping[str, str],
    ) -> Heartbeat:
        """
        Send the agent the environment of nodes, and start the heartbeat.

        :raises VpnError: no heartbeat was answered through the VPN.
        """
        job = self._job
        robot = job.launch.robot_vpn().interface
        try:
            agent.request(
                'configure', timeout=job.timeouts.agent, launch=job.launch.id, again=True,
                heartbeat={'bind': interface.address, 'port': plan.HEARTBEAT_PORT,
                           'peer': robot.address},
                environment={
                    'FOGROS2_VPN_ADDRESS': interface.address,
                    **plan.extended({**ros.environment, **dds}, job.spec.environment)},
                setup=list(ros.setup), ros_command=list(ros.command))
        except AgentError as error:
            if 'in use' in str(error):
                raise VpnError(
                    f"UDP port {plan.HEARTBEAT_PORT} of '{job.name}' is in use already",
                    f"end what listens there: ss -lunp 'sport = :{plan.HEARTBEAT_PORT}'"
                ) from error
            raise
        heartbeat = Heartbeat(interface.address, plan.HEARTBEAT_PORT, job.launch.id)
        job.undo.callback(heartbeat.close)
        try:
            wait_until(
                lambda: heartbeat.round_trip is not None, timeout=job.timeouts.vpn,
                cancel=job.cancel, what='an answer through the VPN', longest=0.05)
        except FogError as error:
            if isinstance(error, Cancelled):
                raise
            raise VpnError(
                f"nothing comes back from '{job.name}' through the VPN",
                f'is UDP port {interface.port} open on the way there?') from error
        if self._rearming is not None:
            self._rearming.close()
        return heartbeat

    # -- the way down ---------------------------------------------------------------------------

    def undo_nodes(self, agent: AgentClient) -> None:
        """Push the undo that stops the nodes; it has to run first on the way down."""
        self._job.undoing('nodes', lambda: self.release(agent))

    def release(self, agent: AgentClient) -> None:
        """Make the agent of a surviving machine stop the nodes and release the machine; once."""
        job = self._job
        if not job.survives or self._released:
            return
        self._released = True
        if self._rearming is not None:
            self._rearming.close()
        with contextlib.suppress(AgentAbsent):
            try:
                # answered when the nodes have ended; an agent out of reach ends them by itself
                agent.request('release', timeout=job.patience(job.timeouts.command), silent=SILENT,
                              launch=job.launch.id, on_exit=job.spec.on_exit,
                              exit=not job.provider.agent_program)
            except DeadlineExceeded:
                job.hurry()
                raise


class _Rearming:
    """Re-arm an agent periodically, until heartbeats come through the VPN."""

    def __init__(self, agent: AgentClient, launch_id: str, interval: float) -> None:
        self._agent = agent
        self._launch_id = launch_id
        self._interval = interval
        self._done = threading.Event()
        threading.Thread(target=self._run, name='fog-rearm', daemon=True).start()

    def _run(self) -> None:
        while not self._done.wait(self._interval):
            try:
                self._agent.request('configure', launch=self._launch_id, again=True)
            except FogError:
                pass  # the next one may get through; the current step reports a lasting failure

    def close(self) -> None:
        """Stop re-arming the agent."""
        self._done.set()
