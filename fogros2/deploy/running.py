# SPDX-License-Identifier: Apache-2.0
"""A machine of the launch that is up, and the nodes on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
import dataclasses
import threading
from typing import Any, Optional

from fogros2 import feature
from fogros2.agent.protocol import MAX_LINE
from fogros2.agent_client import EventCallback
from fogros2.deploy.context import Context
from fogros2.deploy.life import Phase
from fogros2.deploy.machine_job import MachineJob, SILENCE_TIMEOUT
from fogros2.deploy.steps.installing import Modules
from fogros2.deploy.steps.watching import POLL_INTERVAL, Watch
from fogros2.deploy.undo import OPEN_PORT
from fogros2.errors import AgentError, DeadlineExceeded, FogError
from fogros2.events import Event, NodeStatus
from fogros2.model import Machine, MachineSpec, NodeSpec, to_json
from fogros2.plugin_system import cause
from fogros2.report import StepFailed, Warned
from fogros2.waiting import wait_until


@dataclasses.dataclass(frozen=True)
class _Watched:
    """A program that the agent runs until it exits with 0."""

    argv: Sequence[str]
    interval: float
    then: Callable[[str], None]


def _groups(nodes: Sequence[NodeSpec]) -> list[list[NodeSpec]]:
    """
    Divide nodes into groups that each fit into a request.

    :raises AgentError: a node is too large.
    """
    groups: list[list[NodeSpec]] = []
    room, limit = 0, MAX_LINE - 1024  # the rest of a request
    for node in nodes:
        size = len(to_json(node)) + 1
        if size > limit:
            raise AgentError(
                f"'{node.name}' can't be sent: with its parameter files it has {size} bytes, more "
                f'than {limit}', 'put large data into the workspace, and read it there')
        if size > room:
            groups.append([])
            room = limit
        groups[-1].append(node)
        room -= size
    return groups


class RunningMachine(MachineJob):
    """A machine of the launch that comes up or is up, and the nodes on it."""

    #: Installs what some nodes import.
    modules: Modules
    #: The variables of its nodes.
    environment: Mapping[str, str]

    def __init__(self, context: Context, spec: MachineSpec) -> None:
        super().__init__(context, spec)
        self._lock = threading.Lock()
        self._shortening = threading.Lock()
        self._closing = threading.Lock()
        self._callback: Optional[EventCallback] = None
        self._published: dict[int, tuple[str, int]] = {}
        self._watches: dict[str, _Watched] = {}
        #: Steps of the deployment that an agent needs which was started again.
        self.restoring: Sequence[Callable[[], None]] = ()

    def begin(self, found: Callable[[Machine], None] = lambda machine: None) -> None:
        """
        Watch the machine, which is up now, until its end.

        :param found: called with the provider's report when the machine exists but is silent.
        """
        self.enter('up')
        self.undo.callback(Watch(self._context, self, over=self._is_over, found=found).close)

    @property
    def vpn_address(self) -> str:
        """The machine's address in the VPN."""
        return self.interface.address

    @property
    def lost(self) -> str:
        """Why the machine is gone or must not be used any more, '' while it is there."""
        return self.life.lost

    def warn(self, text: str, remedy: str) -> None:
        """Warn the user, with what to do about it on a line of its own."""
        self._context.report(Warned(self.spec.name, f"'{self.spec.name}': {text}", remedy))

    def start(self, nodes: Sequence[NodeSpec]) -> None:
        """
        Start nodes; their state changes arrive as events.

        :raises PrerequisiteError: the machine cannot get what they need.
        :raises AgentError: refused, or a node is too large for a request.
        """
        for each, own in feature.used(self.spec):
            nodes = each.starting(self, nodes, own)
        for group in _groups(self.modules.fitted(nodes)):
            self.agent.request('start', nodes=group)

    def watch(
        self, name: str, argv: Sequence[str], interval: float, then: Callable[[str], None],
    ) -> None:
        """Run a program until it exits with 0; see :class:`fogros2.feature.RunningMachine`."""
        watched = self._watches[name] = _Watched(argv, interval, then)
        self._send_watch(name, watched)

    def _send_watch(self, name: str, watched: _Watched) -> None:
        self.agent.request(
            'watch', what=name, interval=watched.interval, argv=list(watched.argv))

    def restore(self) -> None:
        """
        Give an agent that was started again what it needs, before nodes start.

        :raises FogError: the agent does not take it.
        """
        with self._shortening:  # a step sends the lifetime
            for restore in self.restoring:
                restore()
        for name, watched in list(self._watches.items()):
            self._send_watch(name, watched)

    def stop(self, ids: Optional[Sequence[str]] = None) -> None:
        """Stop nodes by SIGINT, SIGTERM, SIGKILL in turn; all nodes if ``ids`` is None."""
        self._request('stop', nodes=None if ids is None else list(ids))

    def signal(self, node: str, name: str) -> None:
        """Send a node a signal, given by its name (``SIGUSR1``)."""
        self._request('signal', node=node, signal=name)

    def node_states(self) -> Sequence[NodeStatus]:
        """
        Return the states of the nodes that were started.

        :raises FogError: the agent does not answer.
        """
        states: Sequence[NodeStatus] = self._request('status')['nodes']
        return states

    def _request(self, command: str, **arguments: Any) -> Mapping[str, Any]:
        """Send the agent a request, with a shorter time-out while the launch ends."""
        if self._context.cancel.is_set():
            return self.agent.request(command, timeout=self.timeout(30.0),
                                      silent=SILENCE_TIMEOUT, **arguments)
        return self.agent.request(command, timeout=30.0, **arguments)

    def note(self, name: str, text: str) -> None:
        """Let ``ros2 fog`` show a note; see :class:`fogros2.feature.RunningMachine`."""
        self.save(notes={**self.record.notes, name: text})

    def open_port(self, port: int, sources: Sequence[str]) -> tuple[str, int]:
        """
        Open a TCP port of the machine until the machine ends; return (host, port) to connect to.

        :param sources: networks (CIDR) that may connect.
        :raises FogError: the provider cannot open the port.
        """
        if port not in self._published:  # a program that listens there may have restarted
            self.push(OPEN_PORT, port)
            self._published[port] = self.provider.open_port(self.machine, port, sources)
        return self._published[port]

    def subscribe(self, callback: EventCallback) -> None:
        """
        Pass every event of the machine since the start of this launch to ``callback``.

        A thread of the connection or of the watch calls it; ``callback`` must not send requests to
        the agent. After ``MachineLost`` requests fail.
        """
        def tell(event: Event) -> None:
            # an agent that exits at the end of the launch is expected
            expected = event['event'] == 'connection' and self._context.ending.is_set()
            if self.life.over or expected or (
                    event['event'] == 'watched' and self.ending.is_set()):
                return
            if event['event'] != 'watched':
                callback(event)
            elif watched := self._watches.pop(event['what'], None):
                try:
                    watched.then(event['reason'])
                except Exception as error:  # noqa: BLE001 - this thread reads all events
                    self._context.report(StepFailed(
                        self.name, f"watch '{event['what']}'", 0.0, cause(error), fatal=False))

        with self._lock:
            self._callback, life = callback, self.life
        if life.over:
            callback({'event': 'lost', 'reason': life.reason})
            return
        try:
            self.agent.subscribe(tell, since=self.first_event)
        except AgentError:
            # another thread may have reported the loss and closed the connection meanwhile
            if not self.lost:
                raise

    def _is_over(self, phase: Phase, reason: str) -> None:
        """Report, once, that the machine is gone or lost; stop its nodes if it comes back."""
        if phase == 'lost':
            # without heartbeats, the machine ends its nodes by itself
            self.heartbeat.close()
        else:
            # before anything else, which may create the machine anew
            self._context.choices.end(self.spec.name)
        callback = self._enter(phase, reason)
        if callback is not None:
            callback({'event': 'lost', 'reason': reason})
        if phase == 'lost':
            with contextlib.suppress(FogError):
                # they may run on the robot by then
                self.agent.request('stop', nodes=None, timeout=self.spec.robot_timeout)
        self.agent.close()

    def _enter(self, phase: Phase, reason: str = '') -> Optional[EventCallback]:
        """Enter a phase; return the subscriber of its events."""
        with self._lock:
            self.enter(phase, reason)
            return self._callback

    def reclaimed(self, timeout: float) -> bool:
        """
        Return whether the provider confirms a notice of the machine within ``timeout`` seconds.

        :raises Cancelled: the launch ends.
        """
        def confirmed() -> bool:
            with contextlib.suppress(FogError):  # it does not answer: asked again
                return self.provider.reclaims(self.machine_id)
            return False

        try:
            wait_until(lambda: self.lost or confirmed(), timeout=timeout, interval=2.0,
                       longest=POLL_INTERVAL, cancel=self._context.cancel,
                       what='the provider to confirm the notice')
        except DeadlineExceeded:
            return False
        return not self.lost

    def retire(self) -> None:
        """
        Stop the heartbeats, and delete the machine for good, whatever its ``on_exit``.

        :raises FogError: the provider has not confirmed the deletion; nothing else is undone yet.
        """
        self._enter('lost', 'it is replaced')
        self.heartbeat.close()
        self.provider.destroy(self.machine_id)
        self._enter('deleted')
        self.close()

    def give_up(self, reason: str) -> None:
        """Let the launch end the machine and its nodes, and go on without them."""
        with self._lock:
            callback = self._callback
        if callback is not None:
            callback({'event': 'given_up', 'reason': reason})

    def shorten(self) -> None:
        """
        Shorten the lifetime if features allow less now; another machine costs, too.

        :raises FogError: the agent does not answer.
        """
        with self._shortening:
            seconds = self.time_left
            try:
                allowed = self._context.choices.limited(
                    dataclasses.replace(self.spec, lifetime=seconds), made=True).lifetime
            except FogError:
                return  # its time is over
            if self.life.over or self.ending.is_set() or allowed > seconds - 1.0:
                return
            try:
                self.agent.request(
                    'configure', timeout=self._context.timeouts.agent,
                    launch=self._context.launch_id, again=True, lifetime=allowed)
            except FogError:
                if self.life.over or self.ending.is_set():
                    return
                raise
            self.restart_lifetime(allowed)

    def lose_after(self, seconds: float) -> None:
        """Count a silent machine as lost after this time, even if its provider says it runs."""
        self.longest_silence = seconds

    def bear_silence(self, seconds: float) -> None:
        """Count a machine as lost only after this time without a word of it and its provider."""
        self.least_silence = seconds

    def end(self, reason: str) -> bool:
        """
        End the machine as its ``on_exit`` says; its further events are ignored.

        Try again until the machine or the launch ends; return whether the machine has ended.
        """
        self._enter('ended', reason)
        self.close()
        return self.has_ended

    def close(self) -> None:
        """End the machine as its ``on_exit`` says."""
        with self._closing:
            self.undo.close()
