# SPDX-License-Identifier: Apache-2.0
"""One machine of a launch: processes that wait for it, and processes that run on it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
import contextlib
import dataclasses
import functools
import logging
from typing import Any, Literal, Optional, Protocol, TYPE_CHECKING

import launch.logging

from fogros2.describe import values
from fogros2.errors import (
    AgentError,
    ConfigurationError,
    ConnectError,
    DeadlineExceeded,
    FogError,
    ProviderError,
)
from fogros2.events import Event, NodeStatus
from fogros2.model import MachineSpec, NodeSpec
from fogros2.ros_names import remapped
from fogros2.runtime.backlog import Backlog
from fogros2.runtime.log_files import LogFiles
from fogros2.runtime.remote_run import RemoteRun

if TYPE_CHECKING:
    from launch import Action, LaunchContext

    from fogros2.deploy import Launch, RunningMachine
    from fogros2.describe.machines import CloudInstance
    from fogros2.runtime.interruption import MachineInterrupted

#: Events of the agent about the machine, not about one process: log level and message.
_NOTICES = {
    'watchdog': (logging.ERROR, 'the agent ends everything: {reason}'),
    'ending': (logging.WARNING, 'the agent was asked to end: {reason}'),
    'end_failed': (logging.ERROR, 'the machine would not end: exit status {returncode}'),
    'vpn_repaired': (logging.WARNING, 'the VPN was down for {seconds:.1f} s and is up again'),
    'restarted': (logging.ERROR, 'its agent died and was started again; the nodes have ended'),
    'gap': (logging.WARNING, '{count} events of its agent, such as output, were lost'),
    'connection lost': (logging.WARNING, 'the connection to its agent is lost; trying again'),
    'connection back': (logging.INFO, 'the connection is back'),
    'connection absent': (logging.ERROR, 'the agent is gone: {error}'),
}
#: Exit status of processes whose end was not reported.
_UNREPORTED = -9
#: Seconds, at least, before nodes with respawn start again because their agent died.
_RESPAWN_DELAY = 1.0
#: What happens to the machine. ``given_up``: the launch is to go on without it.
_Event = Literal['up', 'gone', 'given_up']
#: The next phase by phase and event; another event is too late.
_NEXT: Mapping[tuple[str, _Event], str] = {
    ('awaited', 'up'): 'up', ('up', 'gone'): 'gone', ('up', 'given_up'): 'over'}


def _last_event(node: NodeStatus) -> Optional[Event]:
    """Return the event after which a node is in its state; None if another event follows."""
    number, name, pid, returncode = node['id'], node['name'], node['pid'], node['returncode']
    if node['state'] == 'running' and pid is not None:
        return {'event': 'started', 'node': number, 'name': name, 'pid': pid, 'cmd': []}
    if node['state'] == 'exited':
        return {'event': 'exited', 'node': number, 'name': name, 'respawns': False,
                'returncode': _UNREPORTED if returncode is None else returncode}
    if node['state'] == 'refused':
        return {'event': 'refused', 'node': number, 'name': name, 'hint': '',
                'error': node.get('error', '')}
    return None


class Robot(Protocol):
    """The robot's side of the launch."""

    @property
    def context(self) -> LaunchContext:
        """The context in which launch runs."""

    @property
    def launch(self) -> Launch:
        """The deployment."""

    @property
    def machines(self) -> Mapping[str, Session]:
        """The sessions of the launch's machines, by name."""

    def take_over(self, machine: str) -> list[Action]:
        """Let features use the robot in a machine's place; return processes to start."""


class Session:
    """
    One machine of a launch, on the event loop.

    The launch ends with it, unless a feature's subclass moves its processes elsewhere.

    :param in_thread: runs a blocking function in a thread.
    :param fail: ends the launch because of an error.
    :param changed: called when the machine came up or a process started or ended.
    :param preempted: called with the session and a reason when the machine is gone.
    :param busy: returns the number of events that launch has to process.
    :param starting: returns nodes as they start on the machine.
    :param robot: what subclasses use of the launch.
    """

    def __init__(
        self, spec: MachineSpec, loop: asyncio.AbstractEventLoop, *,
        in_thread: Callable[..., asyncio.Future[Any]],
        fail: Callable[[BaseException], None], changed: Callable[[], None],
        preempted: Callable[[Session, str], None], busy: Callable[[], int] = lambda: 0,
        starting: Callable[[Sequence[NodeSpec]], Sequence[NodeSpec]] = lambda nodes: nodes,
        robot: Optional[Robot] = None,
    ) -> None:
        #: The spec as the launch file gives it, with open choices.
        self.requested = spec
        self.spec = spec
        #: The launch file's objects for the machine; notified when it is up.
        self.instances: list[CloudInstance] = []
        self.running: Optional[RunningMachine] = None
        #: True when the machine is up, False when it never will be.
        self.came_up: asyncio.Future[bool] = loop.create_future()
        #: Whether programs beside the nodes have been requested.
        self.has_helpers = False
        #: New names of topics and services of its nodes, and what goes on without these nodes.
        self.renamed: dict[str, str] = {}
        self.others = ''
        #: A node without which the launch does not go on, '' without one.
        self._needed = ''
        self._loop = loop
        self._in_thread = in_thread
        self._fail = fail
        self._changed = changed
        self._preempted = preempted
        self._starting = starting
        self._robot = robot
        #: ``awaited``, ``up``, ``gone`` or, if the launch goes on without the machine, ``over``;
        #: subclasses have more.
        self.phase = 'awaited'
        #: Whether only agent, provider or time confirms that a process has left it.
        self.fenced = False
        self._backlog = Backlog(loop, self._on_event, busy, self._dropped)
        self._runs: dict[str, RemoteRun] = {}
        self._to_stop: list[RemoteRun] = []
        #: Processes whose end nobody reported; the machine may yet start them.
        self._unreported: set[str] = set()
        #: Whether a comparison with the agent's state waits.
        self._comparing = False
        #: Paths of the robot that its nodes get, and of which the user knows.
        self._paths: set[str] = set()
        #: Requests to the agent that are not answered yet.
        self.requests: set[asyncio.Task[None]] = set()
        # keeps requests to the agent in order
        self._order = asyncio.Lock()
        self._logger = launch.logging.get_logger('fogros2')
        self._logs = LogFiles()
        #: Why the machine was given up.
        self._reason = ''

    @property
    def interrupted(self) -> bool:
        """Whether no process may start on the machine any more."""
        return self.lost

    @property
    def lost(self) -> bool:
        """Whether the machine is gone."""
        return self.phase == 'gone'

    @property
    def ready(self) -> bool:
        """Whether the machine is up and all of its processes have started or ended."""
        return self.running is not None and all(run.state.started for run in self._runs.values())

    @property
    def _waiting(self) -> list[RemoteRun]:
        return [run for run in list(self._runs.values())
                if run.state.phase == 'waiting' and not run.complete.done()]

    @property
    def planned(self) -> Sequence[NodeSpec]:
        """The processes that wait for the machine."""
        return [run.node for run in self._waiting]

    def add(self, instance: CloudInstance) -> None:
        """Add a launch file's object for this machine."""
        if instance not in self.instances:
            self.instances.append(instance)
            if self.running is not None:
                instance.is_up(self.running)

    def rename(self, names: Mapping[str, str], others: str) -> None:
        """
        Rename topics and services of nodes without which the launch goes on.

        :param others: what goes on, for messages.
        :raises ConfigurationError: the nodes may move to the robot, or others run on the machine.
        """
        self.renamed.update(names)
        self.others = others
        self._check_needed()

    def need(self, node: str) -> None:
        """
        Note a node without which the launch does not go on.

        :raises ConfigurationError: the machine runs nodes without which it does.
        """
        self._needed = node
        self._check_needed()

    def _check_needed(self) -> None:
        if self.others and self._needed:
            raise ConfigurationError(
                f"'{self._needed}' can't run on '{self.spec.name}': topics are renamed there, and "
                f'if that machine is lost, {self.others} go on',
                'give it another machine, or put it into their group')

    def warn_of_paths(self, node: NodeSpec, paths: Sequence[str]) -> None:
        """Warn once of each path of the robot that a node gets."""
        new = [path for path in paths if path not in self._paths]
        self._paths.update(new)
        if new:
            self._logger.warning(
                f"{self.spec.name}: {node.name} gets {', '.join(new)} of this robot, as launch "
                'resolves $(env HOME), $(find-pkg-share) and the like here\nname a path of the '
                'machine, or a file of a package in the workspace, which travels')

    def give_up(self) -> None:
        """Stop waiting for the machine to come up, unless it is up."""
        if not self.came_up.done():
            self.came_up.set_result(False)

    # -- processes ------------------------------------------------------------------------------

    @property
    def sent(self) -> list[NodeSpec]:
        """The nodes that have started, or are about to."""
        return [run.node for run in list(self._runs.values()) if run.state.phase != 'waiting']

    def command_here(self, resolve: Callable[[], list[str]]) -> Optional[list[str]]:
        """
        Return the command of a process on the robot, None if it stays on the machine.

        :param resolve: returns it.
        :raises ConfigurationError: it has to run on the robot, and can't.
        """
        return None

    def submit(self, run: RemoteRun) -> None:
        """Start a process when the machine is up."""
        if self.phase == 'over':
            self._logger.error(
                f'{self.spec.name}: {run.node.name} does not start: the machine has ended, '
                f'because {self._reason} (launch again)')
            run.on('over')
            return
        self._runs[run.node.id] = run
        if self.interrupted:
            run.on('move_gone')
            return
        if self.running is not None:
            self.request(self._start_waiting)

    def stop(self, run: RemoteRun) -> bool:
        """Stop a process; return False if it does not run there and never will."""
        if self.running is None or self.lost:
            return False
        self._to_stop.append(run)
        if len(self._to_stop) == 1:
            self.request(self._stop_collected)
        return True

    def signal(self, run: RemoteRun, name: str) -> None:
        """Send a process a signal."""
        self.request(functools.partial(self._signal, run, name))

    def forget(self, run: RemoteRun) -> None:
        """Remove a process that has ended."""
        self._runs.pop(run.node.id, None)
        if run.get_returncode() is None:
            self._unreported.add(run.node.id)
        self._changed()

    def halted(self, run: RemoteRun) -> bool:
        """Note that a process has left its machine; return whether it must not start elsewhere."""
        return False

    # -- the machine ----------------------------------------------------------------------------

    async def choose(self) -> None:
        """
        Make the requests of choices such as 'nearest', and complete the spec.

        :raises FogError: a choice cannot be made.
        """
        if any(callable(value) for value in self.requested.options.values()):
            options = await self._in_thread(values.await_all, self.requested.options)
            self.spec = dataclasses.replace(self.requested, options=options)

    def up(self, running: RunningMachine) -> None:
        """Start the waiting processes: the machine is up."""
        self.running = running
        self._on('up')
        if not self.came_up.done():
            self.came_up.set_result(True)
        for instance in self.instances:
            instance.is_up(running)
        self.request(self._subscribe)
        self.request(self._start_waiting)
        self._changed()

    def request(self, function: Callable[[], Any]) -> None:
        """Run a coroutine function; the launch waits for it on its way down."""
        task = self._loop.create_task(function())
        self.requests.add(task)
        task.add_done_callback(self._answered)

    def _answered(self, task: asyncio.Task[None]) -> None:
        self.requests.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is not None:
            self._fail(error)

    async def _subscribe(self) -> None:
        assert self.running is not None
        async with self._order:
            await self._in_thread(self.running.subscribe, self._backlog.put)

    async def _start_waiting(self) -> None:
        # one request for all, so that many nodes start at once
        runs, running = self._waiting, self.running
        if not runs or running is None:
            return
        for run in runs:
            run.on('sent')
        try:
            async with self._order:
                await self._in_thread(
                    running.start,
                    self._starting([remapped(run.node, self.renamed) for run in runs]))
        except FogError as error:
            if not self._repeats(runs, running, error):
                self._refused(runs, error)

    def _repeats(self, runs: list[RemoteRun], running: RunningMachine, error: FogError) -> bool:
        """Return whether processes that a machine did not start will start later."""
        return False

    def _refused(self, runs: list[RemoteRun], error: FogError) -> None:
        """
        End processes that did not start.

        :raises FogError: the error, unless it is the machine's doing: others go on then.
        """
        if not isinstance(error, (AgentError, ConnectError, DeadlineExceeded)):
            for run in runs:
                run.on('over')
            raise error
        for run in runs:
            if run.state.phase != 'running':  # the machine may have started it and not answered
                run.on_event({'event': 'refused', 'node': run.node.id, 'name': run.node.name,
                              'error': str(error.args[0]), 'hint': error.hint})

    async def _stop_collected(self) -> None:
        runs, self._to_stop = self._to_stop, []
        assert self.running is not None
        try:
            async with self._order:
                await self._in_thread(self.running.stop, [run.node.id for run in runs])
        except FogError as error:
            self._logger.error(f'{self.spec.name}: {error}; its agent ends the nodes by itself')
            for run in runs:
                run.unreported()

    async def _signal(self, run: RemoteRun, name: str) -> None:
        assert self.running is not None
        try:
            async with self._order:
                await self._in_thread(self.running.signal, run.node.id, name)
        except FogError as error:
            self._logger.error(f'{self.spec.name}: {name} not sent to {run.node.name}: {error}')

    async def _stop_late(self, node: str, name: str) -> None:
        """Stop a process that has started although the launch counts it as ended."""
        assert self.running is not None
        with contextlib.suppress(FogError):
            async with self._order:
                await self._in_thread(self.running.stop, [node])
            self._logger.warning(f'{self.spec.name}: {name} started too late, and was stopped')

    async def _compare(self) -> None:
        """Catch up on events that were lost: compare with the agent's state."""
        assert self.running is not None
        try:
            async with self._order:
                self._comparing = False
                await self._in_thread(self.running.restore)
                nodes = await self._in_thread(self.running.node_states)
        except FogError as error:
            self._logger.warning(f'{self.spec.name}: lost events are not made up for: {error}')
            return
        known = {node['id'] for node in nodes}
        if any(run.state.started and id not in known for id, run in self._runs.items()):
            self._restarted()  # this event was lost, too
            return
        for node in nodes:
            if (event := _last_event(node)) is not None:
                self._backlog.put(event)

    # -- events of the agent --------------------------------------------------------------------

    def _dropped(self, count: int) -> None:
        self._logger.warning(
            f'{self.spec.name}: {count} lines of output were dropped: they came faster than the '
            f"launch shows them; 'ros2 fog logs {self.spec.name}' has the latest")

    def _on_event(self, event: Event) -> None:
        self._logs.add(sum(len(str(value)) for value in event.values()))
        run = self._runs.get(str(event.get('node', '')))
        if run is not None:
            self._on_process_event(run, event)
            return
        if event['event'] == 'started' and event['node'] in self._unreported:
            self._unreported.remove(event['node'])
            self.request(functools.partial(self._stop_late, event['node'], event['name']))
            return
        if event['event'] == 'given_up':
            self.request(functools.partial(self._give_up, event['reason']))
            return
        if event['event'] == 'lost':
            self._on('gone', event['reason'] or 'no reason')
            return
        kind: str = event['event']
        if event['event'] == 'connection':
            kind = f"connection {event['state']}"
        if kind in _NOTICES:
            level, text = _NOTICES[kind]
            self._logger.log(level, f'{self.spec.name}: {text.format_map(event)}')
        if kind == 'watchdog' and self.running is not None:
            self.running.announced = True
        if kind == 'gap' and not self._comparing:
            self._comparing = True
            self.request(self._compare)
        if kind == 'restarted':
            self._restarted()
        elif kind == 'connection absent':
            self._agent_gone()

    def _on_process_event(self, run: RemoteRun, event: Event) -> None:
        run.on_event(event)
        if event['event'] == 'started':
            self._changed()

    def _on(self, event: _Event, reason: str = '') -> None:
        """
        Change the phase, and do what follows.

        :param reason: why the machine is gone, for the user.
        """
        before, self.phase = self.phase, _NEXT.get((self.phase, event), self.phase)
        if before != self.phase == 'gone':
            self._preempted(self, reason)

    def _restarted(self) -> None:
        """Restore the agent, which has died, and start its nodes with respawn again."""
        respawning = self._respawning()
        self._end_unreported(respawning)
        self.request(self._restore)
        self._start_again(respawning)

    async def _restore(self) -> None:
        assert self.running is not None
        try:
            async with self._order:
                await self._in_thread(self.running.restore)
        except FogError as error:
            self._logger.error(
                f'{self.spec.name}: the new agent does not check the VPN: {error}')

    def _agent_gone(self) -> None:
        """End all processes: nobody knows of them any more."""
        respawning = self._respawning()
        self._end_unreported([])
        if respawning and not self.others:
            self._fail(AgentError(
                f"{', '.join(run.node.name for run in respawning)} can't respawn: the agent "
                f"of '{self.spec.name}' is gone", 'launch again'))

    def go_on(self, event: MachineInterrupted, remedy: str = '') -> list[Action]:
        """
        Go on without the machine; return what this needs.

        :param remedy: how the launch would have gone on.
        :raises ProviderError: ends the launch.
        """
        if event.lost:
            self.end_all()
        if self.others:
            self._logger.warning(f'{event}; {self.others} go on')
            return []
        raise ProviderError(str(event), remedy)

    async def _give_up(self, reason: str) -> None:
        """End the machine and its processes, while the launch goes on."""
        before = self.phase
        self._on('given_up')
        if self.phase == before or self.running is None:
            return
        self._reason = reason
        self._logger.info(f"{self.spec.name}: {reason}; on_exit='{self.spec.on_exit}'")
        runs = list(self._runs.values())
        for run in runs:
            run.on('stop')
        await asyncio.gather(*(run.complete for run in runs))
        if await self._in_thread(self.running.end, reason):
            self._logger.info(f'{self.spec.name}: the machine has ended')

    def end_all(self) -> None:
        """End all processes of a machine that is gone, for launch."""
        for run in list(self._runs.values()):
            run.on('over')

    def _respawning(self) -> list[RemoteRun]:
        """Return the processes that start again when they end."""
        return [run for run in self._runs.values()
                if run.state.started and not run.state.stopping and not self.interrupted
                and run.node.respawn and run.node.respawn_max_retries != 0]

    def _start_again(self, runs: list[RemoteRun]) -> None:
        """Start processes, which ended with their agent, in the agent that was started again."""
        for run in runs:
            # an agent starts the same id once
            node = self._runs.pop(run.node.id).node
            run.node = dataclasses.replace(
                node, id=f'{node.id}+', respawn_max_retries=max(-1, node.respawn_max_retries - 1))
            self._runs[run.node.id] = run
            run.on('back')
        if runs:
            delay = max(_RESPAWN_DELAY, *(run.node.respawn_delay for run in runs))
            self._loop.call_later(delay, self.request, self._start_waiting)

    def _end_unreported(self, respawning: list[RemoteRun]) -> None:
        for run in list(self._runs.values()):
            if run.state.phase == 'waiting':
                continue
            node = run.node
            if run in respawning and run.state.phase == 'respawning':
                continue  # the agent has reported the exit
            if run.state.started:
                run.on_event({'event': 'exited', 'node': node.id, 'name': node.name,
                              'returncode': _UNREPORTED, 'respawns': run in respawning})
            else:
                run.on_event({'event': 'refused', 'node': node.id, 'name': node.name,
                              'error': 'the agent of the machine died', 'hint': ''})
