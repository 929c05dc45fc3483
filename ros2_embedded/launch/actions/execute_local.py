# SPDX-License-Identifier: Apache-2.0
"""The action that executes something on this computer."""
from __future__ import annotations

import asyncio
import codecs
import logging
import os
import signal
import traceback
from typing import Any, Callable, cast, Dict, Iterator, List, Optional, Union

import launch.logging

from ..action import Action
from ..conditions import evaluate_condition_expression
from ..descriptions import Executable
from ..event import Event
from ..event_handler import BaseEventHandler, EventHandler
from ..event_handlers import OnProcessExit, OnProcessIO, OnProcessStart, OnShutdown
from ..events import matches_action, Shutdown
from ..events.process import (
    ProcessExited,
    ProcessIO,
    ProcessStarted,
    ProcessStderr,
    ProcessStdout,
    ShutdownProcess,
    SignalProcess,
)
from ..launch_context import LaunchContext
from ..launch_description_entity import LaunchDescriptionEntity
from ..some_entities_type import SomeEntitiesType
from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from ..substitutions import LaunchConfiguration, PythonExpression
from ..utilities import is_a_subclass, normalize_to_list_of_substitutions, perform_substitutions
from ..utilities.type_utils import normalize_typed_substitution, perform_typed_substitution
from ._simple import EmitEvent, OpaqueFunction
from ._structure import TimerAction
from ._subprocess import Protocol, start_process

OnExit = Union[
    SomeEntitiesType, Callable[[ProcessExited, LaunchContext], Optional[SomeEntitiesType]], None]

_SIGTERM_TIMEOUT = LaunchConfiguration('sigterm_timeout', default=5)
_SIGKILL_TIMEOUT = LaunchConfiguration('sigkill_timeout', default=5)


class _Output:
    """A process's output on one descriptor: the lines so far, all of it if ``keep``."""

    def __init__(self, keep: bool) -> None:
        self.__decoder = codecs.getincrementaldecoder('utf-8')(errors='replace')
        self.__keep = keep
        self.text = ''
        self.__seen = 0
        self.__ended = False

    def lines(self, data: bytes) -> Iterator[str]:
        """Take more output; yield the lines that are complete with it."""
        text = self.__decoder.decode(data)
        if self.__ended:
            # The line that this belongs to is out already.
            yield text
            return
        self.text += text
        while (end := self.text.find('\n', self.__seen)) >= 0:
            line = self.text[self.__seen:end]
            self.__seen = end + 1
            yield line
        self.__forget()

    def rest(self, ended: bool) -> Iterator[str]:
        """Yield the last line, if it wasn't complete."""
        rest = self.text[self.__seen:]
        self.__seen = len(self.text)
        self.__ended = ended and not self.__keep
        self.__forget()
        if rest:
            yield rest

    def __forget(self) -> None:
        if not self.__keep:
            self.text = self.text[self.__seen:]
            self.__seen = 0


class ExecuteLocal(Action):
    """
    Executes something, and emits events for its start, output and end.

    :param sigterm_timeout: seconds from SIGINT to SIGTERM when shut down.
    :param sigkill_timeout: seconds from there to SIGKILL.
    :param emulate_tty: whether it thinks that it writes to a terminal.
    :param output: see :func:`launch.logging.get_output_loggers`.
    :param output_format: of each line, with ``line`` and ``this`` (the action).
    :param cached_output: whether :meth:`get_stdout` and :meth:`get_stderr` are wanted.
    :param log_cmd: whether to log the command.
    :param on_exit: entities to visit when it exits, or what returns such.
    :param respawn: whether to start it again when it exits, unless shut down.
    :param respawn_delay: seconds to wait before that.
    :param respawn_max_retries: how often at most; negative for ever.
    """

    def __init__(
        self, *, process_description: Executable, shell: bool = False,
        sigterm_timeout: SomeSubstitutionsType = _SIGTERM_TIMEOUT,
        sigkill_timeout: SomeSubstitutionsType = _SIGKILL_TIMEOUT,
        emulate_tty: bool = False, output: Any = 'log',
        output_format: str = '[{this.process_description.final_name}] {line}',
        cached_output: bool = False, log_cmd: bool = False, on_exit: OnExit = None,
        respawn: Union[bool, SomeSubstitutionsType] = False,
        respawn_delay: Optional[float] = None, respawn_max_retries: int = -1, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.__process_description = process_description
        self.__shell = shell
        self.__sigterm_timeout = normalize_to_list_of_substitutions(sigterm_timeout)
        self.__sigkill_timeout = normalize_to_list_of_substitutions(sigkill_timeout)
        self.__emulate_tty = emulate_tty
        output = os.environ.get('OVERRIDE_LAUNCH_PROCESS_OUTPUT', output)
        self.__output: Union[Dict[str, Any], List[Substitution]] = (
            output if isinstance(output, dict) else normalize_to_list_of_substitutions(output))
        self.__output_format = output_format
        self.__log_cmd = log_cmd
        self.__cached_output = cached_output
        self.__on_exit = on_exit
        self.__respawn = normalize_typed_substitution(respawn, bool)
        self.__respawn_delay = respawn_delay
        self.__respawn_max_retries = respawn_max_retries
        self.__respawn_retries = 0
        self.__process_event_args: Optional[Dict[str, Any]] = None
        self._subprocess_protocol: Optional[Protocol] = None
        self._subprocess_transport: Optional[asyncio.SubprocessTransport] = None
        self.__completed_future: Optional[asyncio.Future[None]] = None
        self.__shutdown_future: Optional[asyncio.Future[None]] = None
        self.__sigterm_timer: Optional[TimerAction] = None
        self.__sigkill_timer: Optional[TimerAction] = None
        self.__stdout_buffer = _Output(cached_output)
        self.__stderr_buffer = _Output(cached_output)
        self.__executed = False

    @property
    def process_description(self) -> Executable:
        """What is executed."""
        return self.__process_description

    @property
    def shell(self) -> bool:
        """Whether a shell executes it."""
        return self.__shell

    @property
    def emulate_tty(self) -> bool:
        """Whether it thinks that it writes to a terminal."""
        return self.__emulate_tty

    @property
    def sigkill_timeout(self) -> List[Substitution]:
        """Seconds from SIGTERM to SIGKILL when shut down."""
        return self.__sigkill_timeout

    @property
    def sigterm_timeout(self) -> List[Substitution]:
        """Seconds from SIGINT to SIGTERM when shut down."""
        return self.__sigterm_timeout

    @property
    def output(self) -> Union[Dict[str, Any], List[Substitution]]:
        """Where its output goes."""
        return self.__output

    @property
    def process_details(self) -> Optional[Dict[str, Any]]:
        """What its events carry: action, name, cmd, cwd, env, and pid once it is there."""
        return self.__process_event_args

    @property
    def return_code(self) -> Optional[int]:
        """The exit status or minus the signal, None before."""
        if self._subprocess_transport is None:
            return None
        return self._subprocess_transport.get_returncode()

    def get_stdout(self) -> str:
        """
        Return all of its standard output so far.

        :raises RuntimeError: without ``cached_output``.
        """
        return self.__cached('stdout', self.__stdout_buffer)

    def get_stderr(self) -> str:
        """
        Return all of its standard error so far.

        :raises RuntimeError: without ``cached_output``.
        """
        return self.__cached('stderr', self.__stderr_buffer)

    def __cached(self, name: str, output: _Output) -> str:
        if not self.__cached_output:
            raise RuntimeError(
                f'cached output must be true to be able to get {name}, '
                f"proc '{self.__process_description.name}'")
        return output.text

    def get_sub_entities(self) -> List[LaunchDescriptionEntity]:
        return self.__on_exit if isinstance(self.__on_exit, list) else []

    def _shutdown_process(
        self, context: LaunchContext, *, send_sigint: bool
    ) -> Optional[List[LaunchDescriptionEntity]]:
        if self.__shutdown_future is None or self.__shutdown_future.done():
            return None
        if self.__completed_future is None or self.__completed_future.done():
            self.__shutdown_future.set_result(None)
            return None
        if self.__process_event_args is None or self._subprocess_transport is None:
            # It is being started: shut it down as soon as it is there.
            context.register_event_handler(OnProcessStart(
                on_start=lambda event, context: self._shutdown_process(
                    context, send_sigint=send_sigint)))
            return None
        self.__shutdown_future.set_result(None)
        context.extend_locals({'process_name': self.__process_event_args['name']})
        actions = self.__make_shutdown_timers()
        if send_sigint:
            actions.append(EmitEvent(event=SignalProcess(
                signal_number=signal.SIGINT, process_matcher=matches_action(self))))
        return actions

    def __make_shutdown_timers(self) -> List[LaunchDescriptionEntity]:
        def escalate(
            period: List[Substitution], received: str, number: Union[str, signal.Signals]
        ) -> TimerAction:
            def report(context: LaunchContext) -> None:
                seconds = perform_substitutions(context, period)
                name = number if isinstance(number, str) else number.name
                self.__logger.error(
                    f"process[{context.locals.process_name}] failed to terminate '{seconds}' "
                    f"seconds after receiving '{received}', escalating to '{name}'")

            event = SignalProcess(signal_number=number, process_matcher=matches_action(self))
            return TimerAction(
                period=period, cancel_on_shutdown=False,
                actions=[OpaqueFunction(function=report), EmitEvent(event=event)])

        both = PythonExpression((
            'float(', *self.__sigterm_timeout, ') + float(', *self.__sigkill_timeout, ')'))
        self.__sigterm_timer = escalate(self.__sigterm_timeout, 'SIGINT', signal.SIGTERM)
        self.__sigkill_timer = escalate([both], 'SIGTERM', 'SIGKILL')
        return [self.__sigterm_timer, self.__sigkill_timer]

    def __on_shutdown(
        self, event: Event, context: LaunchContext
    ) -> Optional[List[LaunchDescriptionEntity]]:
        # A terminal sends SIGINT to the process too.
        interrupted = cast(Shutdown, event).due_to_sigint and not context.noninteractive
        return self._shutdown_process(context, send_sigint=not interrupted)

    def __on_shutdown_process_event(
        self, context: LaunchContext
    ) -> Optional[List[LaunchDescriptionEntity]]:
        if not cast(ShutdownProcess, context.locals.event).process_matcher(self):
            return None
        return self._shutdown_process(context, send_sigint=True)

    def __on_signal_process_event(self, context: LaunchContext) -> None:
        event = cast(SignalProcess, context.locals.event)
        if not event.process_matcher(self):
            return
        if self.__process_event_args is None:
            raise RuntimeError('Signal event received before execution.')
        if self._subprocess_transport is None or self._subprocess_protocol is None:
            raise RuntimeError('Signal event received before subprocess transport available.')
        name = self.__process_event_args['name']
        if self._subprocess_protocol.complete.done():
            self.__logger.debug(
                f"signal '{event.signal_name}' not set to '{name}' because it is already closing")
            return
        self.__logger.info(f"sending signal '{event.signal_name}' to process[{name}]")
        try:
            if event.signal_name == 'SIGKILL':
                self._subprocess_transport.kill()
            else:
                self._subprocess_transport.send_signal(signal.Signals[event.signal_name])
        except ProcessLookupError:
            self.__logger.debug(
                f"signal '{event.signal_name}' not sent to '{name}' because it has closed already")

    def __on_process_stdin(self, event: ProcessIO) -> None:
        self.__logger.warning(f"in ExecuteProcess('{id(self)}').__on_process_stdin_event()")

    def __log(self, logger: logging.Logger, lines: Iterator[str]) -> None:
        for line in lines:
            logger.info(self.__output_format.format(line=line, this=self))

    def __flush_buffers(self, event: Event, context: LaunchContext) -> None:
        ended = self.__shutdown_future is None or self.__shutdown_future.done()
        self.__log(self.__stdout_logger, self.__stdout_buffer.rest(ended))
        self.__log(self.__stderr_logger, self.__stderr_buffer.rest(ended))

    async def __execute_process(self, context: LaunchContext) -> None:
        details = self.__process_event_args
        if details is None:
            raise RuntimeError('process_event_args unexpectedly None')
        cmd, cwd, env = details['cmd'], details['cwd'], details['env']
        words = ' '.join(word for word in cmd if word.strip())
        if self.__log_cmd:
            self.__logger.info(
                f"process details: cmd='{words}', cwd='{cwd}', custom_env?={env is not None}")
        emulate_tty = self.__emulate_tty
        if 'emulate_tty' in context.launch_configurations:
            emulate_tty = evaluate_condition_expression(
                context, normalize_to_list_of_substitutions(
                    context.launch_configurations['emulate_tty']))

        def on_start(pid: int) -> None:
            self.__logger.info(f'process started with pid [{pid}]')
            details['pid'] = pid

        def make_protocol() -> Protocol:
            return Protocol(
                on_start,
                lambda data: context.emit_event_sync(ProcessStdout(text=data, **details)),
                lambda data: context.emit_event_sync(ProcessStderr(text=data, **details)))

        try:
            transport, protocol = await start_process(
                make_protocol, cmd=cmd, cwd=cwd, env=env, shell=self.__shell,
                emulate_tty=emulate_tty)
        except Exception:  # noqa: BLE001 - The launch goes on without this process.
            self.__logger.error(
                f'exception occurred while executing process:\n{traceback.format_exc()}')
            self.__cleanup()
            return
        self._subprocess_transport, self._subprocess_protocol = transport, protocol
        await context.emit_event(ProcessStarted(**details))
        returncode = await protocol.complete
        pid = transport.get_pid()
        if returncode == 0:
            self.__logger.info(f'process has finished cleanly [pid {pid}]')
        else:
            self.__logger.error(
                f"process has died [pid {pid}, exit code {returncode}, cmd '{words}'].")
        await context.emit_event(ProcessExited(returncode=returncode, **details))
        if await self.__wait_to_respawn(context):
            context.asyncio_loop.create_task(self.__execute_process(context))
        else:
            self.__cleanup()

    async def __wait_to_respawn(self, context: LaunchContext) -> bool:
        stopped = self.__shutdown_future
        if not self.__respawn or context.is_shutdown or stopped is None or stopped.done():
            return False
        if 0 <= self.__respawn_max_retries <= self.__respawn_retries:
            return False
        self.__respawn_retries += 1
        if self.__respawn_delay is not None and self.__respawn_delay > 0.0:
            await asyncio.wait((stopped,), timeout=self.__respawn_delay)
        return not stopped.done()

    def __cleanup(self) -> None:
        for timer in (self.__sigterm_timer, self.__sigkill_timer):
            if timer is not None:
                timer.cancel()
        if self._subprocess_transport is not None:
            self._subprocess_transport.close()
        assert self.__completed_future is not None
        if not self.__completed_future.done():
            self.__completed_future.set_result(None)

    def prepare(self, context: LaunchContext) -> None:
        """Work out what exactly will be executed."""
        description = self.__process_description
        description.prepare(context, self)
        self.__process_event_args = {
            'action': self,
            'name': description.final_name,
            'cmd': description.final_cmd,
            'cwd': description.final_cwd,
            'env': description.final_env,
        }
        self.__respawn = perform_typed_substitution(context, self.__respawn, bool)

    def execute(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        """
        Start the process, in the background.

        :raises RuntimeError: if the action was executed before.
        """
        self.prepare(context)
        name = self.__process_description.final_name
        assert name is not None
        if self.__executed:
            raise RuntimeError(
                f"ExecuteLocal action '{name}': executed more than once: {self.describe()}")
        self.__executed = True
        if context.is_shutdown:
            # A process started now would miss the shutdown.
            return None

        def on_output(get_logger: Callable[[], logging.Logger], output: _Output) -> Any:
            return lambda event: self.__log(get_logger(), output.lines(event.text))

        handlers: List[BaseEventHandler] = [
            EventHandler(
                matcher=lambda event: is_a_subclass(event, ShutdownProcess),
                entities=OpaqueFunction(function=self.__on_shutdown_process_event)),
            EventHandler(
                matcher=lambda event: is_a_subclass(event, SignalProcess),
                entities=OpaqueFunction(function=self.__on_signal_process_event)),
            OnProcessIO(
                target_action=self,
                on_stdin=self.__on_process_stdin,
                on_stdout=on_output(lambda: self.__stdout_logger, self.__stdout_buffer),
                on_stderr=on_output(lambda: self.__stderr_logger, self.__stderr_buffer)),
            OnShutdown(on_shutdown=self.__on_shutdown),
            OnProcessExit(target_action=self, on_exit=self.__on_exit),
            OnProcessExit(target_action=self, on_exit=self.__flush_buffers),
        ]
        for handler in handlers:
            context.register_event_handler(handler)
        try:
            self.__completed_future = context.asyncio_loop.create_future()
            self.__shutdown_future = context.asyncio_loop.create_future()
            self.__logger = launch.logging.get_logger(name)
            output = self.__output if isinstance(self.__output, dict) else (
                perform_substitutions(context, self.__output))
            self.__stdout_logger, self.__stderr_logger = (
                launch.logging.get_output_loggers(name, output))
            context.asyncio_loop.create_task(self.__execute_process(context))
        except Exception:
            for handler in handlers:
                context.unregister_event_handler(handler)
            raise
        return None

    def get_asyncio_future(self) -> Optional[asyncio.Future[None]]:
        return self.__completed_future
