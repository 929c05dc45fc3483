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


#: Events that the robot's side alone emits; events of the agent have a ``seq``.
_OURS = ('lost', 'connection', 'gap')


class RunningMachine:
    """
    A machine of the launch that is up, and the nodes on it.

    :param first_event: number of the first agent event that belongs to this launch.
    :param found: called with the provider's report when the machine exists but is silent.
    :param equipment: installs what some nodes import.
    :param containers: downloads the images that some nodes run in.
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
        #: The undo stack that ends the machine.
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
        """Start the machine's launch process ahead of its nodes; once."""
        if not self._warm:
            self._warm = True
            self.agent.request('launch')

    def start(self, nodes: Sequence[NodeSpec]) -> None:
        """
        Start nodes; their state changes arrive as events.

        :raises PrerequisiteError: the machine cannot get their imports or their image.
        """
        nodes = self._equipment.fitted(self._containers.inside(nodes))
        self.agent.request('start', nodes=[_json(node) for node in nodes])

    def stop(self, ids: Optional[Sequence[str]] = None) -> None:
        """Stop nodes by SIGINT, SIGTERM, SIGKILL in turn; all nodes if ``ids`` is None."""
        self._request('stop', nodes=None if ids is None else list(ids))

    def signal(self, node: str, name: str) -> None:
        """Send a node a signal, given by its name (``SIGUSR1``)."""
        self._request('signal', node=node, signal=name)

    def _request(self, command: str, **arguments: Any) -> None:
        """Send the agent a request, with a shorter time-out while the launch ends."""
        if self._launch.cancel.is_set():
            self.agent.request(
                command, timeout=self._job.patience(30.0), silent=SILENT, **arguments)
        else:
            self.agent.request(command, timeout=30.0, **arguments)

    def serves(self, port: int) -> None:
        """Record the TCP port of the Foxglove bridge on the machine."""
        self._job.save(monitor=port)

    def publish(self, port: int, sources: Sequence[str]) -> tuple[str, int]:
        """
        Open a TCP port of the machine until the machine ends; return (host, port) to connect to.

        :param sources: networks (CIDR) that may connect.
        :raises FogError: the provider cannot open the port.
        """
        job = self._job

        def close() -> None:
            # the firewall rule of a deleted machine goes with the machine
            if job.survives or job.spec.on_exit == 'stop':
                job.provider.publish(self.machine, port, ())

        if port not in self._published:  # a program that listens there may have restarted
            self.undo.callback(job.undone, 'port of the monitor', close)
            self._published[port] = job.provider.publish(self.machine, port, sources)
            job.save(monitor_open=monitor_addresses.place(*self._published[port]))
        return self._published[port]

    def subscribe(self, callback: Callable[[dict[str, Any]], None]) -> None:
        """
        Pass every event of the machine since the start of this launch to ``callback``.

        A thread of the connection or of the watch calls it; ``callback`` must not send requests to
        the agent. In addition to the agent's events (see ``agent.py``) there are:

        ``{'event': 'notice', 'reason': ...}``  a preemption notice, once: the provider will
            reclaim the machine. The agent still answers requests until then.
        ``{'event': 'lost', 'reason': ...}``  the machine ended, stopped or was evicted; once, and
            the last event. Requests fail from now on.
        ``{'event': 'connection', 'state': 'lost' | 'back' | 'absent'}``  the connection changed.
        ``{'event': 'gap', 'count': n}``  n events were dropped from the agent's log.
        """
        def tell(event: dict[str, Any]) -> None:
            if self._lost or event['event'] in _OURS and 'seq' in event:
                return  # a hijacked agent must not forge these events
            # an agent that exits at the end of the launch is expected
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
            # another thread may have reported the loss and closed the connection meanwhile
            if not self._lost:
                raise

    def _gone(self, reason: str) -> None:
        """Report, once, that the provider has ended the machine; close the connection."""
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
