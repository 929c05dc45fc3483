# SPDX-License-Identifier: Apache-2.0
"""One machine of a launch: processes that wait for it, and processes that run on it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
import dataclasses
import functools
import logging
from typing import Any, Optional, TYPE_CHECKING

import launch.logging

from fogros2.describe import values
from fogros2.errors import (
    AgentError,
    ConfigurationError,
    ConnectError,
    DeadlineExceeded,
    FogError,
)
from fogros2.events import Event
from fogros2.model import MachineSpec, NodeSpec
from fogros2.ros_names import remapped
from fogros2.runtime import machine_state
from fogros2.runtime.backlog import Backlog
from fogros2.runtime.checkpoints import Checkpoints
from fogros2.runtime.log_files import LogFiles
from fogros2.runtime.machine_state import MachineState
from fogros2.runtime.remote_run import RemoteRun
from fogros2.runtime.replacer import Replacer
from fogros2.shell import Shell

if TYPE_CHECKING:
    from fogros2.deploy import RunningMachine
    from fogros2.describe.machines import CloudInstance

#: Events of the agent about the machine, not about one process: log level and message.
_NOTICES = {
    'watchdog': (logging.ERROR, 'the agent ends everything: {reason}'),
    'ending': (logging.WARNING, 'the agent was asked to end: {reason}'),
    'end_failed': (logging.ERROR, 'the machine would not end: exit status {returncode}'),
    'vpn_repaired': (logging.WARNING, 'the VPN was down for {seconds:.1f} s and is up again'),
    'restarted': (logging.ERROR, 'its agent died and was started again; the nodes have ended'),
    'gap': (logging.WARNING, '{count} events of the agent came too late for its log'),
    'connection lost': (logging.WARNING, 'the connection to its agent is lost; trying again'),
    'connection back': (logging.INFO, 'the connection is back'),
    'connection absent': (logging.ERROR, 'the agent is gone: {error}'),
}
#: Exit status of processes whose end was not reported.
_UNREPORTED = -9
#: Events after which processes end because their machine ends. A session with on_interrupt
#: 'robot' then holds exits back for so many seconds, until it knows whether the machine is gone.
_LAST_EVENTS = ('watchdog', 'ending')
_HOLD = 60.0
#: Seconds in which the provider may confirm a notice; EC2 gives two minutes' notice.
_CONFIRM = 150.0
#: Seconds, at least, before nodes with respawn start again because their agent died.
_RESPAWN_DELAY = 1.0


class Session:
    """
    One machine of a launch, on the event loop.

    :param in_thread: runs a blocking function in a thread.
    :param fail: ends the launch because of an error.
    :param changed: called when the machine came up or a process started or ended.
    :param preempted: called with the session and a reason when the provider reclaims the
        machine, or has done so.
    :param busy: returns the number of events that launch has to process.
    :param starting: returns nodes as they start on the machine.
    """

    def __init__(
        self, spec: MachineSpec, loop: asyncio.AbstractEventLoop, *,
        in_thread: Callable[..., asyncio.Future[Any]],
        fail: Callable[[BaseException], None], changed: Callable[[], None],
        preempted: Callable[[Session, str], None], busy: Callable[[], int] = lambda: 0,
        starting: Callable[[Sequence[NodeSpec]], Sequence[NodeSpec]] = lambda nodes: nodes,
    ) -> None:
        #: The spec as the launch file gives it, with open choices.
        self.requested = spec
        self.spec = spec
        #: The launch file's objects for the machine; notified when it is up.
        self.instances: list[CloudInstance] = []
        self.running: Optional[RunningMachine] = None
        #: True when the machine is up, False when it never will be.
        self.came_up: asyncio.Future[bool] = loop.create_future()
        #: Whether containers and monitor of the machine have been requested.
        self.has_helpers = False
        #: New names of topics and services that the node ``first_answer`` serves on the robot.
        self.replicated: dict[str, str] = {}
        self._loop = loop
        self._in_thread = in_thread
        self._fail = fail
        self._changed = changed
        self._preempted = preempted
        self._starting = starting
        self.state = MachineState(survivable=spec.on_interrupt != 'shutdown')
        self._backlog = Backlog(loop, self._on_event, busy, self._dropped)
        self._held: list[tuple[RemoteRun, Event]] = []
        self._runs: dict[str, RemoteRun] = {}
        self._waiting: list[RemoteRun] = []
        self._to_stop: list[RemoteRun] = []
        #: Replaces the machine, if its ``on_interrupt`` says so.
        self.replacer: Optional[Replacer] = None
        self.checkpoints: Optional[Checkpoints] = None
        #: Processes that have left a machine that is being replaced.
        self._away: list[RemoteRun] = []
        #: Paths of the robot that its nodes get, and of which the user knows.
        self._paths: set[str] = set()
        #: Requests to the agent that are not answered yet.
        self.requests: set[asyncio.Task[None]] = set()
        # keeps requests to the agent in order
        self._order = asyncio.Lock()
        # keeps moves between robot and machines in order
        self._moves = asyncio.Lock()
        self._logger = launch.logging.get_logger('fogros2')
        self._logs = LogFiles()
        #: Why the machine was given up.
        self._reason = ''

    @property
    def interrupted(self) -> bool:
        """Whether the provider reclaims the machine, which may still run, or it is gone."""
        return self.state.interrupted

    @property
    def lost(self) -> bool:
        """Whether the machine is gone."""
        return self.state.phase == 'gone'

    @property
    def ready(self) -> bool:
        """Whether the machine is up and all of its processes have started or ended."""
        return self.running is not None and all(run.state.started for run in self._runs.values())

    @property
    def programs(self) -> Sequence[tuple[str, str]]:
        """The (package, executable) pairs of the processes that wait for the machine."""
        return sorted({
            (run.node.package, run.node.executable) for run in self._waiting
            if run.node.package and not run.node.image})

    @property
    def images(self) -> Sequence[str]:
        """The container images of the processes that wait for the machine."""
        return sorted({run.node.image for run in self._waiting if run.node.image})

    def add(self, instance: CloudInstance) -> None:
        """Add a launch file's object for this machine."""
        if instance not in self.instances:
            self.instances.append(instance)
            if self.running is not None:
                instance.is_up(self.running)

    def replicate(self, names: dict[str, str]) -> None:
        """
        Rename the topics and services of replicated nodes.

        :raises ConfigurationError: another group of replicas has one of them, or the nodes would
            move to the robot, where ``first_answer`` has these names.
        """
        for name in names:
            if name in self.replicated:
                raise ConfigurationError(f"two groups of replicas have '{name}' on the machine "
                                         f"'{self.spec.name}'", 'name it in one of them')
        if self.spec.on_interrupt == 'robot':
            raise ConfigurationError(
                f"replicas cannot move to the robot, as on_interrupt='robot' of "
                f"'{self.spec.name}' wants it", 'leave on_interrupt= out: the others go on')
        self.replicated.update(names)

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
        return [run.node for run in list(self._runs.values()) if run not in self._waiting]

    @property
    def shell(self) -> Optional[Shell]:
        """The shell of the machine, None while the machine does not run the nodes."""
        return None if self.running is None or self.interrupted else self.running.shell

    def nodes(self) -> list[NodeSpec]:
        """Return the machine's nodes that have started."""
        return [run.node for run in self._runs.values() if run.state.started]

    def submit(self, run: RemoteRun) -> None:
        """Start a process when the machine is up."""
        if self.state.phase == 'over':
            self._logger.error(
                f'{self.spec.name}: {run.node.name} does not start: the machine has ended, '
                f'because {self._reason} (launch again)')
            run.on('over')
            return
        self._runs[run.node.id] = run
        if self.replacer is not None:
            self.replacer.allow(run.node)
        if self.interrupted:
            if self.replacer is None:
                run.on('move_gone')
            else:
                run.on('halt_gone')
            return
        self._waiting.append(run)
        if self.running is not None:
            self.request(self._start_waiting)

    def stop(self, run: RemoteRun) -> bool:
        """Stop a process; return False if it does not run there and never will."""
        if run in [*self._waiting, *self._away] or self.running is None or self.lost:
            if run in self._waiting:
                self._waiting.remove(run)
            return False
        for held in self._held:
            if held[0] is run:
                self._held.remove(held)
                run.on_event(held[1])
                return True
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
        self._check_drained()
        self._changed()

    def open_port(
        self, port: int, sources: Sequence[str], opened: Callable[[str, int], None],
    ) -> None:
        """Open a TCP port of the running machine; ``opened`` is called with host and port."""
        async def open_port() -> None:
            assert self.running is not None
            opened(*await self._in_thread(self.running.open_port, port, sources))

        self.request(open_port)

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
        runs, self._waiting = self._waiting, []
        if not runs or self.running is None:
            return
        try:
            async with self._order:
                await self._in_thread(
                    self.running.start,
                    self._starting([remapped(run.node, self.replicated) for run in runs]))
        except (AgentError, ConnectError, DeadlineExceeded) as error:
            # the machine's doing: the nodes of the robot go on
            for run in runs:
                run.on_event({'event': 'refused', 'node': run.node.id, 'name': run.node.name,
                              'error': str(error.args[0]), 'hint': error.hint})
        except FogError:
            for run in runs:
                run.on('over')
            raise

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

    # -- events of the agent --------------------------------------------------------------------

    def _dropped(self, count: int) -> None:
        self._logger.warning(
            f'{self.spec.name}: {count} lines of output were dropped: they came faster than the '
            f"launch shows them; 'ros2 fog logs {self.spec.name}' has the latest")

    def _on_event(self, event: Event) -> None:
        self._logs.add(sum(len(str(value)) for value in event.values()))
        run = self._runs.get(str(event.get('node', '')))
        if run is not None:
            if event['event'] == 'exited' and self.state.phase == 'ending' and (
                    not run.state.stopping):
                self._held.append((run, event))
                return
            run.on_event(event)
            if event['event'] == 'started':
                self._changed()
            return
        if event['event'] == 'given_up':
            self.request(functools.partial(self._give_up, event['reason']))
            return
        if event['event'] == 'lost':
            self._on('gone', event['reason'] or 'no reason')
            return
        if event['event'] == 'notice':
            # of a machine whose nodes move to the robot, nothing ends: the notice may be forged
            self._on('reclaimed' if self.spec.on_interrupt == 'robot' else 'claim',
                     event['reason'] or 'no reason')
            return
        kind: str = event['event']
        if event['event'] == 'connection':
            kind = f"connection {event['state']}"
        if kind in _NOTICES:
            level, text = _NOTICES[kind]
            self._logger.log(level, f'{self.spec.name}: {text.format_map(event)}')
        if kind in _LAST_EVENTS:
            self._on('last_words')
        elif kind == 'restarted' and self.state.phase != 'ending':
            respawning = self._respawning()
            self._end_unreported(respawning)
            self._start_again(respawning)
        elif kind == 'connection absent' and self.state.phase != 'ending' and not (
                self.interrupted and self.replacer):
            respawning = self._respawning()
            self._end_unreported([])
            if respawning and not self.replicated:
                self._fail(AgentError(
                    f"{', '.join(run.node.name for run in respawning)} can't respawn: the agent "
                    f"of '{self.spec.name}' is gone", 'launch again'))

    def _on(self, event: machine_state.Event, reason: str = '') -> None:
        """
        Change the machine's state, and do what follows.

        :param reason: of an interruption, for the user.
        """
        self.state, commands = machine_state.decide(self.state, event)
        for command in commands:
            if command == 'hold':
                self._loop.call_later(_HOLD, self._on, 'spared')
            elif command == 'release':
                held, self._held = self._held, []
                for run, exited in held:
                    run.on_event(exited)
            elif command == 'save':
                self.request(self._last_checkpoint)
            elif command == 'announce':
                self._preempted(self, reason)
            elif command == 'bury':
                self._bury(reason)
            else:
                self._logger.warning(
                    f'{self.spec.name}: the machine reports that its provider reclaims it: '
                    f'{reason}; its nodes go on until the provider confirms that, or the machine '
                    'is gone')
                self.request(functools.partial(self._confirm, reason))

    async def _confirm(self, reason: str) -> None:
        running = self.running
        assert running is not None
        try:
            confirmed = await self._in_thread(running.reclaimed, 0.0)
            if not confirmed:
                if self.checkpoints:
                    self.request(self.checkpoints.take)
                confirmed = await self._in_thread(running.reclaimed, _CONFIRM)
            if running is not self.running or self.interrupted:
                return
            if confirmed:
                self._on('reclaimed', reason)
            else:
                self._logger.info(
                    f'{self.spec.name}: its provider has not confirmed that it reclaims it')
        finally:
            self._on('refuted')

    def _bury(self, reason: str) -> None:
        if self.replacer is not None:
            self.replacer.on('lost')
        else:
            self._logger.info(f'{self.spec.name}: the machine is gone: {reason}')
            self.move_all()

    def move_all(self) -> None:
        """Move all of the machine's processes to the robot."""
        ended = [run for run, _ in self._held]
        self._held.clear()
        for run in list(self._runs.values()):
            run.on('move_gone' if self.lost or run in ended else 'move')

    async def _give_up(self, reason: str) -> None:
        """End the machine and its processes, while the launch goes on."""
        self._on('given_up')
        if self.state.phase != 'over' or self.running is None:
            return
        self._reason = reason
        self._logger.info(f"{self.spec.name}: {reason}; on_exit='{self.spec.on_exit}'")
        runs = list(self._runs.values())
        for run in runs:
            run.on('stop')
        await asyncio.gather(*(run.complete for run in runs))
        await self._in_thread(self.running.end, reason)
        self._logger.info(f'{self.spec.name}: the machine has ended')

    # -- a new machine ---------------------------------------------------------------------------

    async def halt_all(self) -> None:
        """Let the machine end all of its processes, because another machine continues them."""
        if self.checkpoints:
            await self.checkpoints.ask()
        ended = [run for run, _ in self._held]
        self._held.clear()
        for run in list(self._runs.values()):
            run.on('halt_gone' if self.lost or run in ended else 'halt')
        self._check_drained()

    def halted(self, run: RemoteRun) -> bool:
        """Note that a process has left its machine; return whether it must not start elsewhere."""
        if self.replacer is None:
            return False
        self._runs.pop(run.node.id, None)
        if run not in self._away:
            self._away.append(run)
        self._check_drained()
        return not self.replacer.state.moved

    def _check_drained(self) -> None:
        if self.replacer is not None and not self._runs:
            self._on('empty')

    async def _last_checkpoint(self) -> None:
        assert self.running is not None and self.replacer is not None
        if self.checkpoints:
            # nothing writes any more
            await self.checkpoints.save(self.running.shell, still=True)
        self.replacer.on('drained')

    async def move_halted(self) -> None:
        """Let processes start on the robot: the machine no longer runs them."""
        self._held.clear()
        async with self._moves:
            if self.checkpoints:
                await self.checkpoints.restore(self.checkpoints.robot)
            for run in [*self._away, *self._runs.values()]:
                run.on('left')

    def homeless(self) -> list[str]:
        """Return the names of processes that cannot run on the robot."""
        return [run.node.name for run in self._away if run.state.phase == 'away']

    def replace(self, running: RunningMachine) -> None:
        """Use another machine from now on."""
        self.running = running
        self._on('replaced')
        for instance in self.instances:
            instance.is_up(running)

    async def come_back(self) -> None:
        """Move all processes to the new machine."""
        back: dict[RemoteRun, bool] = {}
        async with self._moves:
            was_here = len(self.homeless()) < len(self._away)
            # processes that execute meanwhile join
            while new := [run for run in self._away if run not in back]:
                back.update(zip(new, await asyncio.gather(*(run.come_back() for run in new))))
                if self.checkpoints and self.running is not None:
                    if was_here:
                        await self.checkpoints.save(self.checkpoints.robot, still=True)
                    await self.checkpoints.restore(self.running.shell)
        self._away.clear()
        self._on('returned')
        for run in [run for run, alive in back.items() if alive]:
            self._runs[run.node.id] = run
            self._waiting.append(run)
        self._logger.info(f'{self.spec.name}: a new machine runs the nodes')
        await self._subscribe()
        await self._start_waiting()

    def end_all(self) -> None:
        """End all processes of a machine that is gone, for launch."""
        for run in list(self._runs.values()):
            run.on('over')

    def _respawning(self) -> list[RemoteRun]:
        """Return the processes that start again when they end."""
        return [run for run in self._runs.values() if run not in self._waiting
                and run.state.started and not run.state.stopping and not self.interrupted
                and run.node.respawn and run.node.respawn_max_retries != 0]

    def _start_again(self, runs: list[RemoteRun]) -> None:
        """Start processes, which ended with their agent, in the agent that was started again."""
        for run in runs:
            # an agent starts the same id once
            node = self._runs.pop(run.node.id).node
            run.node = dataclasses.replace(
                node, id=f'{node.id}+', respawn_max_retries=max(-1, node.respawn_max_retries - 1))
            self._runs[run.node.id] = run
        if runs:
            self._waiting += runs
            delay = max(_RESPAWN_DELAY, *(run.node.respawn_delay for run in runs))
            self._loop.call_later(delay, self.request, self._start_waiting)

    def _end_unreported(self, respawning: list[RemoteRun]) -> None:
        for run in list(self._runs.values()):
            if run in self._waiting:
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
