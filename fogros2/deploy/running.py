# SPDX-License-Identifier: Apache-2.0
"""A machine of the launch that is up, and the nodes on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import dataclasses
import threading
from typing import Any, Optional, TYPE_CHECKING

from fogros2 import monitor_addresses
from fogros2.agent_client import AgentClient, Heartbeat
from fogros2.deploy.beside import Containers
from fogros2.deploy.equipping import Equipment
from fogros2.deploy.job import Job, SILENT
from fogros2.deploy.watching import Watch
from fogros2.errors import AgentError
from fogros2.model import Machine, NodeSpec, VpnInterface
from fogros2.shell import Shell

if TYPE_CHECKING:
    from fogros2.deploy.launch import Launch


#: Events that this side alone emits; those of the agent have a ``seq``.
_OURS = ('lost', 'connection', 'gap')


class RunningMachine:
    """
    A machine of the launch that is up, and the nodes on it.

    :param first_event: number of the agent's first event that is this launch's.
    :param found: takes what the provider tells of the machine when its heartbeat stays away.
    :param equipment: brings what some nodes import.
    :param containers: brings the images that some run in.
    """

    def __init__(
        self, launch: Launch, job: Job, machine: Machine, shell: Shell, agent: AgentClient,
        heartbeat: Heartbeat, interface: VpnInterface, first_event: int,
        found: Callable[[Machine], None], equipment: Equipment, containers: Containers,
    ) -> None:
        self.spec = job.spec
        self.machine = machine
        self.shell = shell
        self.agent = agent
        self.heartbeat = heartbeat
        self.vpn_address = interface.address
        self.interface = interface
        #: The machine's way down.
        self.undo = contextlib.ExitStack()
        self._launch = launch
        self._job = job
        self._equipment = equipment
        self._containers = containers
        self._first_event = first_event
        self._warm = False
        self._lock = threading.Lock()
        self._callbacks: list[Callable[[dict[str, Any]], None]] = []
        self._lost = ''
        self._published: dict[int, tuple[str, int]] = {}
        self._watch: Optional[Watch] = None
        if job.provider.owned:
            self._watch = Watch(job, agent, heartbeat, gone=self._gone, found=found)
            job.undo.callback(self._watch.close)

    def warm(self) -> None:
        """Start the process that will run the nodes, unless it runs."""
        if not self._warm:
            self._warm = True
            self.agent.request('launch')

    def start(self, nodes: Sequence[NodeSpec]) -> None:
        """
        Start nodes; what becomes of them arrives as events.

        :raises PrerequisiteError: the machine can't have what they import, or their image.
        """
        nodes = self._equipment.fitted(self._containers.inside(nodes))
        self.agent.request('start', nodes=[_json(node) for node in nodes])

    def stop(self, ids: Optional[Sequence[str]] = None) -> None:
        """Stop nodes in order (SIGINT, SIGTERM, SIGKILL), all without ``ids``."""
        self._request('stop', nodes=None if ids is None else list(ids))

    def signal(self, node: str, name: str) -> None:
        """Send a node a signal, by its name (``SIGUSR1``)."""
        self._request('signal', node=node, signal=name)

    def _request(self, command: str, **arguments: Any) -> None:
        """Ask the agent for something; at the end nobody out of reach is waited for."""
        if self._launch.cancel.is_set():
            self.agent.request(
                command, timeout=self._job.patience(30.0), silent=SILENT, **arguments)
        else:
            self.agent.request(command, timeout=30.0, **arguments)

    def serves(self, port: int) -> None:
        """Remember the TCP port of the bridge to Foxglove that runs there."""
        self._job.save(monitor=port)

    def publish(self, port: int, sources: Sequence[str]) -> tuple[str, int]:
        """
        Let networks (CIDR) reach a TCP port of the machine until its end; return where they do.

        :raises FogError: the provider doesn't open it.
        """
        job = self._job

        def close() -> None:
            # what ends takes it along
            if job.survives or job.spec.on_exit == 'stop':
                job.provider.publish(self.machine, port, ())

        if port not in self._published:  # what listens there may have been started again
            self.undo.callback(job.undone, 'port of the monitor', close)
            self._published[port] = job.provider.publish(self.machine, port, sources)
            job.save(monitor_open=monitor_addresses.place(*self._published[port]))
        return self._published[port]

    def subscribe(self, callback: Callable[[dict[str, Any]], None]) -> None:
        """
        Hand every event of the machine since this launch has it to ``callback``.

        It is called from a thread of the connection's, or from one that watches the machine, and
        must not make requests of the agent. Besides what the agent says (see ``agent.py``):

        ``{'event': 'notice', 'reason': ...}``  the provider is about to take the machine away, by
            its own words; once. The agent answers requests still, for as long as they say.
        ``{'event': 'lost', 'reason': ...}``  the machine is gone: ended, stopped, evicted; once,
            and nothing comes after it. Requests fail from now on.
        ``{'event': 'connection', 'state': 'lost' | 'back' | 'absent'}``  the connection's changes.
        ``{'event': 'gap', 'count': n}``  so many events came too late for the agent's log.
        """
        def tell(event: dict[str, Any]) -> None:
            if self._lost or event['event'] in _OURS and 'seq' in event:
                return  # the machine's agent has no say in these
            # an agent that leaves at the end as it was told is no news
            if event['event'] != 'connection' or not self._launch.ending:
                callback(event)

        with self._lock:
            self._callbacks.append(callback)
            lost = self._lost
        if lost:
            callback({'event': 'lost', 'reason': lost})
            return
        try:
            self.agent.subscribe(tell, since=self._first_event)
        except AgentError:
            # that it is gone may have been told meanwhile, and the connection closed
            if not self._lost:
                raise

    def _gone(self, reason: str) -> None:
        """Tell, once, that the provider has the machine no longer; nobody else asks it."""
        with self._lock:
            self._lost = reason
            callbacks = list(self._callbacks)
        for callback in callbacks:
            callback({'event': 'lost', 'reason': reason})
        self.agent.close()

    def close(self) -> None:
        """End the machine as its ``on_exit`` says."""
        self.undo.close()


def _json(node: NodeSpec) -> dict[str, Any]:
    return {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
