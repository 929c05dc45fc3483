# SPDX-License-Identifier: Apache-2.0
"""One machine of a launch: the processes that wait for it, and those that run on it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
import functools
from typing import Any, Optional, Protocol, TYPE_CHECKING, TypeVar

import launch.logging

from fogros2.errors import FogError
from fogros2.model import MachineSpec, NodeSpec

if TYPE_CHECKING:
    from fogros2.deploy import RunningMachine

T = TypeVar('T')

#: Events of the agent that concern the machine, not one process: how they read.
_NOTICES = {
    'watchdog': 'the agent stops everything: {reason}',
    'vpn_repaired': 'the VPN was down and is up again',
    'launch_exited': 'the launch on the machine ended with exit status {returncode}',
    'lost': 'the connection is lost: {reason}',
}


class Run(Protocol):
    """What a session needs of a process; all calls come from the event loop."""

    node: NodeSpec
    started: bool
    stopping: bool

    def on_event(self, event: dict[str, Any]) -> None:
        """Take an event of the agent that names this process."""

    def end(self) -> None:
        """Take it that nothing more will happen."""


class Session:
    """
    One machine of a launch, on the event loop.

    :param in_thread: runs a blocking function in a thread.
    :param fail: ends the launch because of an error.
    :param changed: is called when the machine came up or a process started or ended.
    """

    def __init__(
        self, spec: MachineSpec, loop: asyncio.AbstractEventLoop, *,
        in_thread: Callable[..., asyncio.Future[Any]],
        fail: Callable[[BaseException], None], changed: Callable[[], None],
    ) -> None:
        self.spec = spec
        self.running: Optional[RunningMachine] = None
        self.deployment: Optional[asyncio.Task[None]] = None
        self._loop = loop
        self._in_thread = in_thread
        self._fail = fail
        self._changed = changed
        self._runs: dict[str, Run] = {}
        self._waiting: list[Run] = []
        self._to_stop: list[Run] = []
        self._flushes: set[asyncio.Task[None]] = set()
        # requests reach the agent in the order they were made in
        self._order = asyncio.Lock()
        self._logger = launch.logging.get_logger('fogros2')

    @property
    def ready(self) -> bool:
        """Whether the machine is up and all that was to start there has started, or ended."""
        return self.running is not None and all(run.started for run in self._runs.values())

    @property
    def programs(self) -> Sequence[tuple[str, str]]:
        """The (package, executable) pairs of what waits for the machine."""
        return sorted({
            (run.node.package, run.node.executable) for run in self._waiting
            if run.node.package})

    # -- processes ------------------------------------------------------------------------------

    def submit(self, run: Run) -> None:
        """Start a process as soon as the machine is up."""
        self._runs[run.node.id] = run
        self._waiting.append(run)
        if self.running is not None:
            self._soon(self._start_waiting)

    def stop(self, run: Run) -> bool:
        """End a process there; False if it isn't there yet and now never will be."""
        if run in self._waiting or self.running is None:
            if run in self._waiting:
                self._waiting.remove(run)
            return False
        self._to_stop.append(run)
        if len(self._to_stop) == 1:
            self._soon(self._stop_collected)
        return True

    def signal(self, run: Run, name: str) -> None:
        """Send a process a signal."""
        self._soon(functools.partial(self._signal, run, name))

    def forget(self, run: Run) -> None:
        """Take a process off the list: it ended."""
        self._runs.pop(run.node.id, None)
        self._changed()

    # -- the machine ----------------------------------------------------------------------------

    def up(self, running: RunningMachine) -> None:
        """Take it that the machine is up: what waited for it starts."""
        self.running = running
        running.subscribe(self._event_in_thread)
        self._soon(self._start_waiting)
        self._changed()

    def _soon(self, function: Callable[[], Any]) -> None:
        task = self._loop.create_task(function())
        self._flushes.add(task)
        task.add_done_callback(self._flushed)

    def _flushed(self, task: asyncio.Task[None]) -> None:
        self._flushes.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is not None:
            self._fail(error)

    async def _start_waiting(self) -> None:
        # in one request, so that many nodes start at once
        runs, self._waiting = self._waiting, []
        if not runs or self.running is None:
            return
        try:
            async with self._order:
                await self._in_thread(self.running.start, [run.node for run in runs])
        except FogError:
            for run in runs:
                run.end()
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
                run.end()

    async def _signal(self, run: Run, name: str) -> None:
        assert self.running is not None
        try:
            async with self._order:
                await self._in_thread(self.running.signal, run.node.id, name)
        except FogError as error:
            self._logger.error(f'{self.spec.name}: {name} not sent to {run.node.name}: {error}')

    # -- what the agent says --------------------------------------------------------------------

    def _event_in_thread(self, event: dict[str, Any]) -> None:
        try:
            self._loop.call_soon_threadsafe(self._on_event, event)
        except RuntimeError:
            return  # the launch's event loop is closed: nobody is left to tell

    def _on_event(self, event: dict[str, Any]) -> None:
        run = self._runs.get(event.get('node', ''))
        if run is not None:
            run.on_event(event)
            if event['event'] == 'started':
                self._changed()
            return
        notice = _NOTICES.get(event['event'])
        if notice is not None:
            self._logger.warning(f'{self.spec.name}: {notice.format(**event)}')
        if event['event'] == 'launch_exited':
            for run in list(self._runs.values()):
                if run in self._waiting:
                    continue
                run.on_event({**event, 'event': 'exited'} if run.started else {
                    'event': 'refused', 'error': 'the launch on the machine ended'})
