# SPDX-License-Identifier: Apache-2.0
"""Follow one process on a machine, from its execution to its end or its move to the robot."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
import dataclasses
import re
import signal
from typing import Any, Optional, Protocol, Union

from launch import LaunchContext
from launch.actions import ExecuteLocal
from launch.events.process import (
    ProcessExited,
    ProcessIO,
    ProcessStarted,
    ProcessStderr,
    ProcessStdout,
)
import launch.logging

from fogros2.events import Event, NodeExited, NodeOutput, NodeStarted
from fogros2.launch_internals import private
from fogros2.model import MachineSpec, NodeSpec
from fogros2.runtime import run_state
from fogros2.runtime.added_process import AddedProcess
from fogros2.runtime.run_state import RunState

#: Texts of a process that a signal interrupted while it started: NumPy, for one, turns Python's
#: KeyboardInterrupt into an ImportError, and rclpy and rclcpp find an invalid context.
_INTERRUPTED = re.compile(
    r'KeyboardInterrupt|Traceback \(most recent call last\)|context is (not |in)valid')
#: Messages of Qt, GTK and Tk that there is no screen.
_NO_SCREEN = re.compile(
    r'Qt platform plugin|could not connect to display|cannot open display|GTK backend|'
    r'no \$DISPLAY environment variable', re.IGNORECASE)
#: Seconds that the machine has, beyond a process's own time-outs, to report its end.
GRACE = 10.0
#: Seconds after a process's start in which it may still import what handles SIGINT.
STARTING = 5.0
#: Characters of a line after which launch, which joins its parts, gets an end of the line.
LONGEST_LINE = 1 << 16
#: Characters of output that are withheld, and those that an event counts beside its text.
WITHHELD, OVERHEAD = 1 << 20, 1000


class Home(Protocol):
    """The machine of a process; the event loop makes all calls."""

    spec: MachineSpec
    #: Whether only agent, provider or time confirms that a process has left it.
    fenced: bool

    def signal(self, run: RemoteRun, name: str) -> None:
        """Send a process a signal."""

    def stop(self, run: RemoteRun) -> bool:
        """Stop a process; return False if it does not run there and never will."""

    def forget(self, run: RemoteRun) -> None:
        """Remove a process that has ended."""

    def halted(self, run: RemoteRun) -> bool:
        """Note that a process has left its machine; return whether it must not start elsewhere."""


class RemoteRun:
    """
    One process on a machine, from its execution to its end.

    launch's ExecuteLocal uses it as the subprocess's transport and protocol.

    :param come_here: starts the process on the robot; None if it cannot run there.
    :param go_back: ends the process on the robot, because it is about to start on its machine.
    """

    def __init__(
        self, action: ExecuteLocal, context: LaunchContext, session: Home, node: NodeSpec,
        come_here: Optional[Callable[[LaunchContext], None]],
        go_back: Callable[[RemoteRun], Awaitable[None]],
    ) -> None:
        completed = private.completed(action)
        assert completed is not None
        self.node = node
        #: Whether FogROS2 added the process to the launch.
        self.added = isinstance(action, AddedProcess)
        self.complete = completed
        self._action = action
        self._come_here = come_here
        self._go_back = go_back
        self.state = RunState(movable=come_here is not None)
        self._hinted = False
        self._started_at = 0.0
        #: Output since the process was stopped while it started; None for other processes.
        self._withheld: Optional[list[NodeOutput]] = None
        #: Characters since the last end of a line, by stream.
        self._unended: dict[type[ProcessIO], int] = {}
        self._context = context
        self._session = session
        self._details: dict[str, Any] = dict(action.process_details or {})
        self._returncode: Optional[int] = None
        self._logger = launch.logging.get_logger(f'{session.spec.name}.{node.name}')
        if private.option(action, 'log_cmd'):
            self._logger.info(f"process details: cmd='{' '.join(self._details['cmd'])}'")

    # -- launch calls these as on a transport ---------------------------------------------------

    def get_returncode(self) -> Optional[int]:
        """Return the exit status, None until the process has ended."""
        return self._returncode

    def send_signal(self, number: Union[int, str]) -> None:
        """Send the process a signal, given by number or name."""
        name = number if isinstance(number, str) else signal.Signals(number).name
        if self.state.started:
            self._session.signal(self, name)
        else:
            self._logger.warning(f"'{name}' not sent: the process hasn't started yet")

    def kill(self) -> None:
        """Send SIGKILL to the process."""
        self.send_signal(signal.SIGKILL)

    def close(self) -> None:
        """Do nothing: there is no transport to close."""

    # -- its state ------------------------------------------------------------------------------

    def on(self, event: run_state.Event, said: Optional[Event] = None) -> None:
        """
        Change the state, and do what follows.

        :param said: the agent's event behind it.
        """
        if self.complete.done():
            return  # launch has ended it
        self.state, commands = run_state.decide(self.state, event)
        for command in commands:
            if command == 'report':
                self._report(said)
            else:
                getattr(self, f'_{command}')()

    def unreported(self) -> None:
        """Stop waiting for the remote process: the agent will not report its exit."""
        if self.state.phase != 'leaving' or not self._session.fenced:
            self.on('absent')

    async def come_back(self) -> bool:
        """Prepare the start on the new machine; return False if the process has ended."""
        if self.state.phase == 'here' and not self.complete.done():
            await self._go_back(self)
        self.on('back')
        self.node = dataclasses.replace(self.node, id=f'{self.node.id}+')
        return not self.complete.done()

    def _ask(self) -> None:
        if self.state.stopping and self._withheld is None and (
                not self.state.started
                or self._context.asyncio_loop.time() - self._started_at < STARTING):
            self._withheld = []
        if not self._session.stop(self):
            self.on('absent')

    def _expect(self) -> None:
        seconds = self.node.sigterm_timeout + self.node.sigkill_timeout + GRACE
        self._context.asyncio_loop.call_later(seconds, self.on, 'overdue')

    def _leave(self) -> None:
        if not self._session.halted(self):
            self.on('stop' if self._context.is_shutdown else 'free')

    def _come(self) -> None:
        assert self._come_here is not None
        self._session.forget(self)
        # launch sees a new start, and no exit before it
        self._come_here(self._context)

    def _end(self) -> None:
        if not self.complete.done():
            self.complete.set_result(None)
        self._session.forget(self)

    # -- events of the agent --------------------------------------------------------------------

    def on_event(self, event: Event) -> None:
        """Turn an event of the agent into launch's event."""
        if event['event'] == 'output':
            if not (self.state.over or self.complete.done()):
                self._print(event)
        elif event['event'] == 'exited':
            self.on('respawns' if event['respawns'] else 'exited', event)
        elif event['event'] == 'refused' or event['event'] == 'started' and not (
                # known from the agent's status already
                self.state.phase in ('running', 'leaving')
                and event['pid'] == self._details.get('pid')):
            self.on(event['event'], event)

    def _report(self, said: Optional[Event]) -> None:
        """Tell launch what the agent says, or that it says nothing."""
        if said is None:
            self._logger.error(
                f"machine '{self._session.spec.name}' did not report the end of the process; "
                'its agent will end it')
        elif said['event'] == 'started':
            self._report_start(said)
        elif said['event'] == 'exited':
            self._report_exit(said)
        elif said['event'] == 'refused':
            hint = f" ({said['hint']})" if said['hint'] else ''
            self._logger.error(f"process can't be started: {said['error']}{hint}")

    def _report_start(self, event: NodeStarted) -> None:
        self._started_at, self._returncode = self._context.asyncio_loop.time(), None
        details = self._action.process_details
        assert details is not None
        details['pid'] = event['pid']
        if event['cmd']:
            details['cmd'] = list(event['cmd'])
        self._details = dict(details)
        self._logger.info(f"process started with pid [{event['pid']}]")
        self._context.emit_event_sync(ProcessStarted(**self._details))

    def _print(self, event: NodeOutput) -> None:
        if self._withheld is not None:
            self._withheld.append(event)
            if sum(OVERHEAD + len(each['text']) for each in self._withheld) > WITHHELD:
                withheld, self._withheld = self._withheld, None
                for each in withheld:
                    self._print(each)
            return
        if not self._hinted and _NO_SCREEN.search(event['text']):
            self._hinted = True
            self._logger.warning(
                'the process opens a window, and a machine has no screen: run the node on the '
                'robot, switch its window off, or set QT_QPA_PLATFORM=offscreen for it')
        text = event['text']
        kind = ProcessStderr if event['stream'] == 'stderr' else ProcessStdout
        unended = 0 if '\n' in text else self._unended.get(kind, 0)
        unended += len(text) - text.rfind('\n') - 1
        if unended >= LONGEST_LINE:
            text += '\n'
            unended = 0
        self._unended[kind] = unended
        self._details.setdefault('pid', 0)
        self._context.emit_event_sync(kind(text=text.encode(), **self._details))

    def _report_exit(self, event: NodeExited) -> None:
        self._returncode = event['returncode']
        self._details.setdefault('pid', 0)
        pid = self._details['pid']
        withheld, self._withheld = self._withheld, None
        half = withheld is not None and (
            self._returncode in (-signal.SIGINT, -signal.SIGTERM)
            or self._returncode and any(_INTERRUPTED.search(each['text']) for each in withheld))
        for output in () if half else withheld or ():
            self._print(output)
        if half:
            self._logger.warning(f'process was ended while it started [pid {pid}]')
        elif self._returncode == 0:
            self._logger.info(f'process has finished cleanly [pid {pid}]')
        else:
            command = ' '.join(word for word in self._details['cmd'] if word)
            self._logger.error(
                f"process has died [pid {pid}, exit code {self._returncode}, cmd '{command}'].")
        self._context.emit_event_sync(
            ProcessExited(returncode=self._returncode, **self._details))
