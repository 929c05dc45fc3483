# SPDX-License-Identifier: Apache-2.0
"""One machine of a launch: processes that wait for it, and processes that run on it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
import dataclasses
import functools
import logging
from typing import Any, Optional, Protocol, TYPE_CHECKING, TypeVar

import launch.logging

from fogros2.actions import streaming, uncompressed, words
from fogros2.errors import FogError
from fogros2.model import MachineSpec, NodeSpec

if TYPE_CHECKING:
    from fogros2.actions.machines import CloudInstance
    from fogros2.deploy import RunningMachine

T = TypeVar('T')

#: Events of the agent about the machine, not about one process: log level and message.
_NOTICES = {
    'watchdog': (logging.ERROR, 'the agent ends everything: {reason}'),
    'ending': (logging.WARNING, 'the agent was asked to end: {reason}'),
    'end_failed': (logging.ERROR, 'the machine would not end: exit status {returncode}'),
    'vpn_repaired': (logging.WARNING, 'the VPN was down for {seconds:.1f} s and is up again'),
    'launch_exited': (
        logging.ERROR, 'the launch on the machine ended with exit status {returncode}'),
    'gap': (logging.WARNING, '{count} events of the agent came too late for its log'),
    'connection lost': (logging.WARNING, 'the connection is lost; its nodes run on'),
    'connection back': (logging.INFO, 'the connection is back'),
    'connection absent': (logging.ERROR, 'the agent is gone: {error}'),
}
#: Required fields of events about a process; a hijacked machine may send anything.
_SAID: dict[str, dict[str, type]] = {
    'started': {'pid': int}, 'output': {'text': str}, 'exited': {'returncode': int},
    'refused': {'error': str},
}
#: Exit status of processes whose end was not reported.
_UNSEEN = -9
#: Events after which processes end because their machine ends. A session with on_interrupt
#: 'robot' then holds exits back for so many seconds, until it knows whether the machine is gone.
_LAST_EVENTS = ('watchdog', 'ending')
_HOLD = 60.0


class Run(Protocol):
    """The interface of a process to its session; the event loop makes all calls."""

    node: NodeSpec
    started: bool
    stopping: bool

    def on_event(self, event: dict[str, Any]) -> None:
        """Handle an event of the agent that names this process."""

    def end(self) -> None:
        """Stop waiting for events of the process: none will come."""

    def unseen(self) -> None:
        """Stop waiting for the remote process: the agent will not report its exit."""

    def move(self, *, stop: bool) -> None:
        """Move to the robot; with ``stop``, after the machine has ended the process."""


class Session:
    """
    One machine of a launch, on the event loop.

    :param in_thread: runs a blocking function in a thread.
    :param fail: ends the launch because of an error.
    :param changed: called when the machine came up or a process started or ended.
    :param taken_away: called with the session and a reason when the provider reclaims the
        machine, or has done so.
    """

    def __init__(
        self, spec: MachineSpec, loop: asyncio.AbstractEventLoop, *,
        in_thread: Callable[..., asyncio.Future[Any]],
        fail: Callable[[BaseException], None], changed: Callable[[], None],
        taken_away: Callable[[Session, str], None],
    ) -> None:
        #: The spec as the launch file gives it, with open choices.
        self.asked = spec
        self.spec = spec
        #: The launch file's objects for the machine; notified when it is up.
        self.instances: list[CloudInstance] = []
        self.running: Optional[RunningMachine] = None
        self.deployment: Optional[asyncio.Task[None]] = None
        #: True when the machine is up, False when it never will be.
        self.came_up: asyncio.Future[bool] = loop.create_future()
        #: Whether containers and monitor of the machine have been requested.
        self.furnished = False
        #: New names of topics for its nodes, because of streams.
        self.names: dict[str, str] = {}
        self._loop = loop
        self._in_thread = in_thread
        self._fail = fail
        self._changed = changed
        self._taken_away = taken_away
        #: Whether the provider reclaims the machine; it may still run.
        self.interrupted = False
        #: Whether the machine is gone.
        self.lost = False
        self._ending = False
        self._held: list[tuple[Run, dict[str, Any]]] = []
        self._runs: dict[str, Run] = {}
        self._waiting: list[Run] = []
        self._to_stop: list[Run] = []
        #: Topic names that the first loaded components got; None if none was loaded.
        self._told: Optional[dict[str, str]] = None
        #: Requests to the agent that are not answered yet.
        self.requests: set[asyncio.Task[None]] = set()
        # keeps requests to the agent in order
        self._order = asyncio.Lock()
        self._logger = launch.logging.get_logger('fogros2')

    @property
    def ready(self) -> bool:
        """Whether the machine is up and all of its processes have started or ended."""
        return self.running is not None and all(run.started for run in self._runs.values())

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

    def rename(self, names: dict[str, str]) -> None:
        """Rename topics for nodes that start from now on; warn of nodes that started before."""
        new = [name for name in names if name not in self.names]
        self.names = dict(names)
        early = [run.node.name for run in self._runs.values()
                 if run not in self._waiting and '--ros-args' in run.node.arguments]
        if new and early:
            self._logger.warning(
                f"{self.spec.name}: {', '.join(early)} started before {', '.join(new)} became a "
                'stream and take it unencoded; use a FogROSLaunchDescription, or stream it where '
                'the first node of the machine stands')
        self._warn_of_components()

    def told_to_components(self) -> dict[str, str]:
        """Return the new topic names for components that are about to be loaded."""
        self._told = dict(self.names) if self._told is None else {
            name: new for name, new in self._told.items() if name in self.names}
        return dict(self.names)

    def _warn_of_components(self) -> None:
        late = [name for name in self.names if self._told is not None and name not in self._told]
        if late:
            self._logger.warning(
                f"{self.spec.name}: components were loaded before {', '.join(late)} became a "
                'stream and take it unencoded; stream it where the container stands')
            self._told = None

    def give_up(self) -> None:
        """Stop waiting for the machine to come up, unless it is up."""
        if not self.came_up.done():
            self.came_up.set_result(False)

    # -- processes ------------------------------------------------------------------------------

    def node_names(self) -> list[str]:
        """Return the ROS names of the machine's nodes."""
        return [uncompressed.node_name(run.node) for run in list(self._runs.values())]

    def submit(self, run: Run) -> None:
        """Start a process when the machine is up."""
        self._runs[run.node.id] = run
        if self.interrupted:
            run.move(stop=False)
            return
        self._waiting.append(run)
        if self.running is not None:
            self._request(self._start_waiting)

    def stop(self, run: Run) -> bool:
        """Stop a process; return False if it does not run there and never will."""
        if run in self._waiting or self.running is None or self.lost:
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
            self._request(self._stop_collected)
        return True

    def signal(self, run: Run, name: str) -> None:
        """Send a process a signal."""
        self._request(functools.partial(self._signal, run, name))

    def forget(self, run: Run) -> None:
        """Remove a process that has ended."""
        self._runs.pop(run.node.id, None)
        self._changed()

    def publish(
        self, port: int, sources: Sequence[str], told: Callable[[str, int], None],
    ) -> None:
        """Open a TCP port of the running machine; ``told`` is called with host and port."""
        async def publish() -> None:
            assert self.running is not None
            told(*await self._in_thread(self.running.publish, port, sources))

        self._request(publish)

    # -- the machine ----------------------------------------------------------------------------

    async def choose(self) -> None:
        """
        Make the requests of choices such as 'nearest', and complete the spec.

        :raises FogError: a choice cannot be made.
        """
        if any(callable(value) for value in self.asked.options.values()):
            options = await self._in_thread(words.answered, self.asked.options)
            self.spec = dataclasses.replace(self.asked, options=options)

    def up(self, running: RunningMachine) -> None:
        """Start the waiting processes: the machine is up."""
        self.running = running
        if not self.came_up.done():
            self.came_up.set_result(True)
        for instance in self.instances:
            instance.is_up(running)
        self._request(self._subscribe)
        self._request(self._start_waiting)
        self._changed()

    def _request(self, function: Callable[[], Any]) -> None:
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
            await self._in_thread(self.running.subscribe, self._event_in_thread)

    async def _start_waiting(self) -> None:
        # one request for all, so that many nodes start at once
        runs, self._waiting = self._waiting, []
        if not runs or self.running is None:
            return
        deaf = [run.node.name for run in runs if '--ros-args' not in run.node.arguments]
        if self.names and deaf:
            self._logger.warning(
                f"{self.spec.name}: {', '.join(deaf)} takes no ROS arguments, so it isn't told "
                f"that {', '.join(self.names)} is a stream; should it be a ROS node that uses "
                "one, add '--ros-args' to its command")
        try:
            async with self._order:
                await self._in_thread(
                    self.running.start,
                    [streaming.remapped(run.node, self.names) for run in runs])
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
                run.unseen()

    async def _signal(self, run: Run, name: str) -> None:
        assert self.running is not None
        try:
            async with self._order:
                await self._in_thread(self.running.signal, run.node.id, name)
        except FogError as error:
            self._logger.error(f'{self.spec.name}: {name} not sent to {run.node.name}: {error}')

    # -- events of the agent --------------------------------------------------------------------

    def _event_in_thread(self, event: dict[str, Any]) -> None:
        try:
            self._loop.call_soon_threadsafe(self._on_event, event)
        except RuntimeError:
            return  # the launch's event loop is closed

    def _on_event(self, event: dict[str, Any]) -> None:
        if not _makes_sense(event):
            self._logger.warning(f'{self.spec.name}: its agent says what makes no sense')
            return
        run = self._runs.get(event.get('node', ''))
        if run is not None:
            if event['event'] == 'exited' and self._ending and not run.stopping:
                self._held.append((run, event))
                return
            run.on_event(event)
            if event['event'] == 'started':
                self._changed()
            return
        if event['event'] in ('notice', 'lost'):
            self._interrupted(event['event'] == 'lost', str(event.get('reason') or 'no reason'))
            return
        what = ' '.join([event['event'], *([event['state']] if 'state' in event else [])])
        if what in _NOTICES:
            level, text = _NOTICES[what]
            # an agent of another version may omit it
            said = f": {event['said']}" if event.get('said') else ''
            self._logger.log(level, f'{self.spec.name}: {text.format_map(_Told(event))}{said}')
        if what in _LAST_EVENTS and self.spec.on_interrupt == 'robot' and not self.interrupted:
            self._ending = True
            self._loop.call_later(_HOLD, self._let_go)
        elif what in ('launch_exited', 'connection absent') and not self._ending:
            self._end_unseen(event.get('returncode', _UNSEEN))

    def _interrupted(self, lost: bool, reason: str) -> None:
        first = not self.interrupted
        self.interrupted, self.lost = True, self.lost or lost
        self._ending = False
        if first:
            self._taken_away(self, reason)
        elif lost:
            self._logger.info(f'{self.spec.name}: the machine is gone: {reason}')
            self.move_all()

    def move_all(self) -> None:
        """Move all of the machine's processes to the robot."""
        ended = [run for run, _ in self._held]
        self._held.clear()
        for run in list(self._runs.values()):
            run.move(stop=not self.lost and run not in ended)

    def end_all(self) -> None:
        """End all processes of a machine that is gone, for launch."""
        for run in list(self._runs.values()):
            run.end()

    def _let_go(self) -> None:
        """Report the exits that were held back: the machine is not known to be gone."""
        self._ending = False
        held, self._held = self._held, []
        for run, event in held:
            run.on_event(event)

    def _end_unseen(self, returncode: int) -> None:
        for run in list(self._runs.values()):
            if run in self._waiting:
                continue
            run.on_event({'event': 'exited', 'returncode': returncode} if run.started else {
                'event': 'refused', 'error': 'the launch on the machine ended'})


def _makes_sense(event: dict[str, Any]) -> bool:
    said = _SAID.get(event['event'], {}) if isinstance(event['event'], str) else None
    return (
        said is not None and isinstance(event.get('node', ''), str)
        and isinstance(event.get('state', ''), str)
        and isinstance(event.get('seconds', 0.0), (int, float))
        and isinstance(event.get('returncode', 0), int)
        and isinstance(event.get('cmd', []), list)
        and all(isinstance(word, str) for word in event.get('cmd', []))
        and all(isinstance(event.get(key), kind) for key, kind in said.items()))


class _Told(dict[str, Any]):
    """Fields of an event, with '?' for missing ones."""

    def __missing__(self, key: str) -> Any:
        return _Unknown()


class _Unknown:
    def __format__(self, spec: str) -> str:
        return '?'
