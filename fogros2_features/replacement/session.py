# SPDX-License-Identifier: Apache-2.0
"""A machine of a launch whose processes go on when it ends: on the robot, or on a new machine."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
import functools
import os
from typing import Any, Optional, TYPE_CHECKING

from fogros2 import plan
from fogros2.errors import ConfigurationError, ConnectError, DeadlineExceeded, FogError
from fogros2.events import Event
from fogros2.model import NodeSpec
from fogros2.runtime.interruption import MachineInterrupted
from fogros2.runtime.remote_run import RemoteRun
from fogros2.runtime.session import Session
from fogros2.shell import Shell
from fogros2_features.replacement import machine_state
from fogros2_features.replacement.checkpoints import Checkpoints
from fogros2_features.replacement.machine_state import MachineState
from fogros2_features.replacement.options import folder_of, Options
from fogros2_features.replacement.replacer import Replacer

if TYPE_CHECKING:
    from launch import Action

    from fogros2.deploy import RunningMachine

#: Events after which processes end because their machine ends. With on_interrupt='robot', exits
#: are then held back for so many seconds, until it is known whether the machine is gone.
_LAST_EVENTS = ('watchdog', 'ending')
_HOLD = 60.0
#: Seconds in which the provider may confirm a notice; EC2 gives two minutes' notice.
_CONFIRM = 150.0
#: Seconds before the end of its lifetime from which a machine that is lost counts as over.
_LAST = 60.0
#: Seconds until processes are started again that a machine did not start.
_AGAIN = 1.0


class Interruptible(Session):
    """
    One machine of a launch, on the event loop.

    :param own: what the launch file says of its interruption.
    """

    def __init__(self, own: Options, *words: Any, **named: Any) -> None:
        super().__init__(*words, **named)
        self.own = own
        self.fenced = own.replaces
        self.state = MachineState(survivable=own.on_interrupt != 'shutdown')
        self._held: list[tuple[RemoteRun, Event]] = []
        #: What follows from the end of the agent, while exits are held back.
        self._postponed: Optional[Callable[[], None]] = None
        self.replacer: Optional[Replacer] = None
        self.checkpoints: Optional[Checkpoints] = None
        #: Processes that have left a machine that is being replaced.
        self._away: list[RemoteRun] = []
        # keeps moves between robot and machines in order
        self._moves = asyncio.Lock()
        if own.replaces:
            assert self._robot is not None
            context, launch = self._robot.context, self._robot.launch
            if own.checkpoint:
                self._check_alone(own.checkpoint)
            self.replacer = Replacer(
                self, launch, self._loop, in_thread=self._in_thread,
                is_over=lambda: context.is_shutdown, logger=self._logger)
            self.checkpoints = Checkpoints(
                self, context,
                launch.store.launch_folder(launch.id) / 'checkpoints' / self.spec.name,
                f'.before-{launch.id}', launch.cancel, in_thread=self._in_thread,
                logger=self._logger)

    @property
    def interrupted(self) -> bool:
        """Whether the provider reclaims the machine, which may still run, or it is gone."""
        return self.state.interrupted

    # -- processes ------------------------------------------------------------------------------

    def rename(self, names: Mapping[str, str], others: str) -> None:
        """Rename topics and services of nodes; see the base class."""
        if self.own.on_interrupt == 'robot':
            raise ConfigurationError(
                f"replicas cannot move to the robot, as on_interrupt='robot' of "
                f"'{self.spec.name}' wants it", 'leave on_interrupt= out: the others go on')
        super().rename(names, others)

    def command_here(self, resolve: Callable[[], list[str]]) -> Optional[list[str]]:
        """Return the command of a process on the robot, None if it stays on machines."""
        if self.own.on_interrupt == 'shutdown' or self.others:
            return None
        try:
            return resolve()
        except ConfigurationError as error:
            if self.own.replaces:
                return None  # it waits for the new machine
            raise ConfigurationError(
                str(error.args[0]), "on_interrupt='robot' moves it there: "
                f"{error.hint}, or say on_interrupt='shutdown'") from error

    @property
    def shell(self) -> Optional[Shell]:
        """The shell of the machine, None while the machine does not run the nodes."""
        if self.running is None or self.interrupted or self.phase == 'over':
            return None
        return self.running.shell

    def nodes(self) -> list[NodeSpec]:
        """Return the machine's nodes that have started."""
        return [run.node for run in self._runs.values() if run.state.started]

    def submit(self, run: RemoteRun) -> None:
        """Start a process when the machine is up; elsewhere, if the machine is interrupted."""
        if self.replacer is None or self.phase == 'over':
            super().submit(run)
            return
        if self.checkpoints is not None and (folder := folder_of(run.node)):
            self._check_alone(folder)
            self.checkpoints.add(folder)
        self.replacer.allow(run.node)
        if self.interrupted:
            self._runs[run.node.id] = run
            run.on('halt_gone')
        else:
            super().submit(run)

    def _check_alone(self, folder: str) -> None:
        """
        Check that no other machine's nodes would use a folder of this one's on the robot.

        :raises ConfigurationError: some would.
        """
        assert self._robot is not None
        here = os.path.expanduser(folder)
        for other in self._robot.machines.values():
            kept = getattr(other, 'checkpoints', None)
            for used in kept.folders if kept is not None and other is not self else ():
                there = os.path.expanduser(used)
                if plan.below(here, [there]) or plan.below(there, [here]):
                    raise ConfigurationError(
                        f"'{other.spec.name}' and '{self.spec.name}' have one checkpoint folder, "
                        f'which both would use on the robot: {folder}',
                        'give each machine a folder of its own')

    def _repeats(self, runs: list[RemoteRun], running: RunningMachine, error: FogError) -> bool:
        """Return whether processes start later: on this machine, or on one in its place."""
        if not self.fenced or self.phase == 'over':
            return False
        assert self._robot is not None
        if self._robot.context.is_shutdown:
            return False
        if running.lost or running is not self.running:
            return True  # they leave it as all its processes do
        if not isinstance(error, (ConnectError, DeadlineExceeded)):
            return False
        self._logger.warning(
            f'{self.spec.name}: {len(runs)} nodes did not start: {error}; trying again')
        for run in runs:
            # a process that the machine has started nevertheless is not in this phase, or leaves
            # it when the machine reports that
            if run.state.phase == 'sent' and not run.state.stopping:
                run.on('back')
        self._loop.call_later(_AGAIN, self.request, self._start_waiting)
        return True

    def stop(self, run: RemoteRun) -> bool:
        """Stop a process; return False if it does not run there and never will."""
        if run in self._away:
            return False
        for held in [] if self.lost else self._held:
            if held[0] is run:
                self._held.remove(held)
                run.on_event(held[1])
                return True
        return super().stop(run)

    def forget(self, run: RemoteRun) -> None:
        """Remove a process that has ended."""
        super().forget(run)
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

    # -- events ---------------------------------------------------------------------------------

    def _on_process_event(self, run: RemoteRun, event: Event) -> None:
        if event['event'] == 'exited' and self.phase == 'ending' and not run.state.stopping:
            self._held.append((run, event))
        else:
            super()._on_process_event(run, event)

    def _on_event(self, event: Event) -> None:
        super()._on_event(event)
        if event['event'] == 'notice':
            # where nodes move to the robot, nothing ends: the notice may be forged
            self._on('reclaimed' if self.own.on_interrupt == 'robot' else 'claim',
                     event['reason'] or 'no reason')
        elif event['event'] in _LAST_EVENTS:
            self._on('last_words')

    def _restarted(self) -> None:
        self._if_spared(super()._restarted)

    def _agent_gone(self) -> None:
        if not (self.interrupted and self.fenced):
            self._if_spared(super()._agent_gone)

    def _if_spared(self, act: Callable[[], None]) -> None:
        """Act now, or when it is known that the machine is not gone."""
        if self.phase == 'ending':
            self._postponed = act
        else:
            act()

    def _on(self, event: machine_state.Event, reason: str = '') -> None:
        """
        Change the machine's state, and do what follows.

        :param reason: of an interruption, for the user.
        """
        self.state, commands = machine_state.decide(self.state, event)
        self.phase = self.state.phase
        for command in commands:
            if command == 'hold':
                self._postponed = None
                self._loop.call_later(_HOLD, self._on, 'spared')
            elif command == 'release':
                held, self._held = self._held, []
                respawning = self._respawning() if self._postponed else []
                for run, exited in held:
                    if run not in respawning:
                        run.on_event(exited)
                if self._postponed:
                    self._postponed()
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

    def go_on(self, event: MachineInterrupted, remedy: str = '') -> list[Action]:
        """Apply ``on_interrupt``; return what this needs; see the base class."""
        if self.own.on_interrupt != 'robot' and event.lost and (
                self.running is not None and self.running.time_left < _LAST):
            return super().go_on(event, 'its time was over: raise lifetime=, or the budget '
                                 'that shortens it')
        if self.replacer is not None:
            self._logger.warning(f'{event}; a new machine will continue its nodes')
            self.replacer.on('lost' if event.lost else 'notice')
            return []
        if self.own.on_interrupt == 'robot':
            assert self._robot is not None
            self._logger.warning(f'{event}; its nodes continue on the robot')
            actions = self._robot.take_over(self.spec.name)
            self.move_all()
            return actions
        return super().go_on(event, "on_interrupt='robot' continues its nodes on the robot")

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

    # -- a new machine --------------------------------------------------------------------------

    async def halt_all(self) -> None:
        """Let the machine end all of its processes, because another machine continues them."""
        if self.checkpoints:
            await self.checkpoints.ask()
        ended = [run for run, _ in self._held]
        self._held.clear()
        for run in list(self._runs.values()):
            run.on('halt_gone' if self.lost or run in ended else 'halt')
        self._check_drained()

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

    async def stay(self) -> list[str]:
        """End, after moves under way, what the robot cannot run; return the nodes' names."""
        async with self._moves:
            homeless = [run for run in self._away if run.state.phase == 'away']
        for run in homeless:
            run.on('over')
        return [run.node.name for run in homeless if not run.added]

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
            was_here = any(run.state.phase != 'away' for run in self._away)
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
        self._logger.info(f'{self.spec.name}: a new machine runs the nodes')
        await self._subscribe()
        await self._start_waiting()
