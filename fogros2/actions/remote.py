# SPDX-License-Identifier: Apache-2.0
"""Processes of the launch that run on a machine, as launch's own process actions see them."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
import signal
from typing import Any, Optional, TYPE_CHECKING, Union

from launch import LaunchContext, LaunchDescriptionEntity
from launch.actions import ExecuteLocal
from launch.event_handlers import OnProcessIO
from launch.events.process import ProcessExited, ProcessStarted, ProcessStderr, ProcessStdout
import launch.logging

from fogros2.actions import carriers, node_spec, private
from fogros2.actions.coordinator import Coordinator
from fogros2.actions.machines import CloudInstance
from fogros2.errors import ConfigurationError
from fogros2.model import NodeSpec

if TYPE_CHECKING:
    from fogros2.actions.session import Session
    from fogros2.image_transport.streams import Entry

#: Seconds beyond a process's own time-outs that its machine has to report the end of it.
GRACE = 10.0


class RemoteProcess(ExecuteLocal):
    """
    A process action whose process is on a machine.

    A base to stand behind the action proper (``class CloudNode(Node, RemoteProcess)``): the
    method resolution order then has it between Node and ExecuteLocal, whose execution it keeps
    but for the start of the process.
    """

    _fogros2_machine: Union[CloudInstance, str]
    _fogros2_streams: Sequence[Entry] = ()
    _fogros2_session: Session
    _fogros2_node: NodeSpec

    @property
    def machine(self) -> Union[CloudInstance, str]:
        """The machine that the process runs on, or its name."""
        return self._fogros2_machine

    def prepare(self, context: LaunchContext) -> None:
        """Resolve the action as ExecuteLocal does, and what will travel."""
        coordinator = Coordinator.of(context)
        self._fogros2_session = session = coordinator.session(self._fogros2_machine)
        node_spec.use_names_of_programs(self)
        super().prepare(context)
        private.prefix_output(self, session.spec.name)
        self._fogros2_node = node_spec.from_action(
            self, context, coordinator.base_environment, session.spec, coordinator.launch.id)

    def execute(self, context: LaunchContext) -> Optional[list[LaunchDescriptionEntity]]:
        """Execute the action: its process is started as soon as its machine is up."""
        if context.is_shutdown:
            return None
        entities = super().execute(context)
        future = private.completed(self)
        assert future is not None
        run = RemoteRun(self, context, self._fogros2_session, self._fogros2_node, future)
        private.set_transport(self, run)
        context.register_event_handler(OnProcessIO(target_action=self, on_stdin=run.on_stdin))
        self._fogros2_session.submit(run)
        return [*(entities or ()), *self._carriers(context)]

    def _carriers(self, context: LaunchContext) -> list[ExecuteLocal]:
        """Return the processes that carry the streams asked for here and nowhere before."""
        if isinstance(self, carriers.Carrier):
            return []
        session = self._fogros2_session
        found: list[ExecuteLocal] = []
        for machine, spec in Coordinator.of(context).stream(self._fogros2_streams, session):
            if machine is None:
                found.append(carriers.RobotCarrier(spec, session.came_up))
            else:
                found.append(carriers.Carrier(spec))
                send(found[-1], self._fogros2_machine)
        return found

    async def _ExecuteLocal__execute_process(self, context: LaunchContext) -> None:
        """Do nothing: the session starts the process and hands over what happens to it."""

    def _shutdown_process(
        self, context: LaunchContext, *, send_sigint: bool,
    ) -> Optional[list[LaunchDescriptionEntity]]:
        # launch leaves SIGINT to the terminal where that sends it to the nodes too; not here.
        # The machine itself goes on to SIGTERM and SIGKILL, so a lost link can't keep it from it
        run: Optional[RemoteRun] = private.transport(self)
        if run is not None:
            run.stop()
        return None


class RemoteRun:
    """
    One process on a machine, from its execution to its end.

    To launch's ExecuteLocal it is the subprocess's transport and protocol in one.
    """

    def __init__(
        self, action: ExecuteLocal, context: LaunchContext, session: Session, node: NodeSpec,
        completed: asyncio.Future[None],
    ) -> None:
        self.node = node
        self.action = action
        self.complete = completed
        self.started = False
        self.stopping = False
        #: It exited, and its machine will start it again.
        self.respawning = False
        self._context = context
        self._session = session
        self._details: dict[str, Any] = dict(action.process_details or {})
        self._returncode: Optional[int] = None
        self._logger = launch.logging.get_logger(f'{session.spec.name}.{node.name}')
        if private.options(action).log_cmd:
            self._logger.info(f"process details: cmd='{' '.join(self._details['cmd'])}'")

    # -- what launch asks of a transport --------------------------------------------------------

    def get_pid(self) -> Optional[int]:
        """Return the process's id on its machine, None before it started."""
        return self._details.get('pid')

    def get_returncode(self) -> Optional[int]:
        """Return the exit status, None while there is none."""
        return self._returncode

    def send_signal(self, number: Union[int, str]) -> None:
        """Send the process a signal, by its number or its name."""
        name = number if isinstance(number, str) else signal.Signals(number).name
        if self.started:
            self._session.signal(self, name)
        else:
            self._logger.warning(f"'{name}' not sent: the process hasn't started yet")

    def kill(self) -> None:
        """End the process at once."""
        self.send_signal(signal.SIGKILL)

    def close(self) -> None:
        """Let go of the process; nothing is held here."""

    # -- ending ---------------------------------------------------------------------------------

    def stop(self) -> None:
        """End the process in order: SIGINT, SIGTERM and SIGKILL as its time-outs say."""
        if self.complete.done() or self.stopping:
            return
        self.stopping = True
        if not self._session.stop(self) or self.respawning:
            # nothing runs, so there is no end of it to be reported
            self.end()
            return
        patience = self.node.sigterm_timeout + self.node.sigkill_timeout + GRACE
        self._context.asyncio_loop.call_later(patience, self.give_up)

    def give_up(self) -> None:
        """Stop waiting for a process that should have ended long ago."""
        if not self.complete.done():
            self._logger.error(
                f"machine '{self._session.spec.name}' doesn't say that the process ended; "
                f'its agent will end it')
            self.end()

    def end(self) -> None:
        """Tell launch that nothing more will happen."""
        if not self.complete.done():
            self.complete.set_result(None)
        self._session.forget(self)

    # -- what the agent says --------------------------------------------------------------------

    def on_event(self, event: dict[str, Any]) -> None:
        """Turn an event of the agent into launch's."""
        handler = getattr(self, f"_on_{event['event']}", None)
        if handler is not None and not self.complete.done():
            handler(event)

    def _on_started(self, event: dict[str, Any]) -> None:
        self.started = True
        self.respawning = False
        details = self.action.process_details
        assert details is not None
        details['pid'] = event['pid']
        if event.get('cmd'):
            details['cmd'] = list(event['cmd'])
        self._details = dict(details)
        self._logger.info(f"process started with pid [{event['pid']}]")
        self._context.emit_event_sync(ProcessStarted(**self._details))
        if self.stopping:
            self._session.stop(self)

    def _on_output(self, event: dict[str, Any]) -> None:
        kind = ProcessStderr if event.get('stream') == 'stderr' else ProcessStdout
        self._details.setdefault('pid', 0)
        self._context.emit_event_sync(kind(text=event['text'].encode(), **self._details))

    def _on_exited(self, event: dict[str, Any]) -> None:
        self._returncode = event['returncode']
        self._details.setdefault('pid', 0)
        pid = self._details['pid']
        if self._returncode == 0:
            self._logger.info(f'process has finished cleanly [pid {pid}]')
        else:
            command = ' '.join(word for word in self._details['cmd'] if word)
            self._logger.error(
                f"process has died [pid {pid}, exit code {self._returncode}, cmd '{command}'].")
        self._context.emit_event_sync(
            ProcessExited(returncode=self._returncode, **self._details))
        self.respawning = bool(event.get('respawns'))
        if not self.respawning or self.stopping:
            self.end()

    def _on_refused(self, event: dict[str, Any]) -> None:
        hint = f" ({event['hint']})" if event.get('hint') else ''
        self._logger.error(f"process can't be started: {event['error']}{hint}")
        self.end()

    def on_stdin(self, event: object) -> None:
        """Refuse input: there is no way for it to the machine."""
        self._logger.error('a process on a machine takes no input from launch')


def send(
    action: ExecuteLocal, machine: Union[CloudInstance, str], streams: Sequence[Entry] = (),
) -> None:
    """
    Turn an action that hasn't been executed yet into one whose process is on ``machine``.

    The object stays the same one, so handlers that have it as their target go on to match.

    :param streams: topics to stream between the robot and the machine, resolved.
    :raises ConfigurationError: it is of a kind that can't be sent.
    """
    try:
        action.__class__ = _remote_class(type(action))
    except TypeError as error:
        raise ConfigurationError(
            f"{type(action).__name__} can't run on a machine: {error}",
            'take it out of the CloudGroup') from error
    assert isinstance(action, RemoteProcess)
    action._fogros2_machine = machine
    action._fogros2_streams = streams


_remote_classes: dict[type[ExecuteLocal], type[RemoteProcess]] = {}


def _remote_class(cls: type[ExecuteLocal]) -> type[RemoteProcess]:
    if cls not in _remote_classes:
        # ExecuteLocal itself can't stand before a class derived from it
        bases = (RemoteProcess,) if cls is ExecuteLocal else (cls, RemoteProcess)
        _remote_classes[cls] = type(
            cls.__name__, bases, {'__module__': cls.__module__, '__doc__': cls.__doc__})
    return _remote_classes[cls]
