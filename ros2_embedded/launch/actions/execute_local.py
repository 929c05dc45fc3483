# SPDX-License-Identifier: Apache-2.0
"""The action that executes something on this computer."""
from __future__ import annotations

import asyncio
import codecs
import contextlib
import functools
import logging
import os
import signal
import traceback
from typing import Any, Callable, Iterator

import launch.logging

from .. import _base
from ..conditions import evaluate_condition_expression
from ..descriptions import Executable
from ..event_handlers import OnProcessExit, OnProcessIO, OnProcessStart, OnShutdown, SomeReaction
from ..events import matches_action, process
from ..launch_context import LaunchContext
from ..substitutions import LaunchConfiguration, PythonExpression
from ..utilities import normalize_to_list_of_substitutions, perform_substitutions
from ..utilities.type_utils import normalize_typed_substitution, perform_typed_substitution
from ._simple import EmitEvent, OpaqueFunction
from ._structure import TimerAction

OnData = Callable[[bytes], None]

_SIGTERM_TIMEOUT = LaunchConfiguration('sigterm_timeout', default=5)
_SIGKILL_TIMEOUT = LaunchConfiguration('sigkill_timeout', default=5)


class _Output:
    """A process's output on one descriptor, as lines, and all of it if ``keep``."""

    def __init__(self, keep: bool) -> None:
        self.text: str | None = '' if keep else None
        self.__decoder = codecs.getincrementaldecoder('utf-8')(errors='replace')
        self.__rest = ''
        self.__ended = False

    def lines(self, data: bytes) -> Iterator[str]:
        """Take more output; yield the lines that are complete with it."""
        text = self.__decoder.decode(data)
        if self.text is not None:
            self.text += text
        *complete, self.__rest = (self.__rest + text).split('\n')
        yield from complete
        if self.__ended:
            # The line that this belongs to is out already.
            yield from self.rest(True)

    def rest(self, ended: bool) -> Iterator[str]:
        """Yield the last line, if it wasn't complete."""
        rest, self.__rest = self.__rest, ''
        self.__ended = ended
        if rest:
            yield rest


class Protocol(asyncio.SubprocessProtocol):
    """Hands on what a process writes, by file descriptor, and its id as soon as there is one."""

    def __init__(self, on_start: Callable[[int], None], on_data: dict[int, OnData]) -> None:
        self.complete: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self.__on_start = on_start
        self.on_data = on_data
        self.__transport: Any = None

    def connection_made(self, transport: Any) -> None:
        self.__transport = transport
        self.__on_start(transport.get_pid())

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        self.on_data[fd](data)

    def process_exited(self) -> None:
        if not self.complete.done():
            self.complete.set_result(self.__transport.get_returncode())


class _TerminalReader(asyncio.Protocol):

    def __init__(self, on_data: OnData) -> None:
        self.__on_data = on_data

    def data_received(self, data: bytes) -> None:
        self.__on_data(data)


async def _start_process(
    make_protocol: Callable[[], Protocol], *, cmd: list[str], shell: bool, emulate_tty: bool,
    **kwargs: Any
) -> tuple[asyncio.SubprocessTransport, Protocol]:
    """
    Start a process, in this process group, with a pipe as standard input.

    :raises OSError: if it can't be started.
    """
    loop = asyncio.get_running_loop()
    # What isn't meant to be inherited is marked so; closing one by one would only take time.
    kwargs['close_fds'] = False
    terminals = [os.openpty(), os.openpty()] if emulate_tty else []
    try:
        for name, (_, slave) in zip(('stdout', 'stderr'), terminals):
            kwargs[name] = slave
        if shell:
            transport, protocol = await loop.subprocess_shell(
                make_protocol, ' '.join(cmd), **kwargs)
        else:
            transport, protocol = await loop.subprocess_exec(make_protocol, *cmd, **kwargs)
    except BaseException:
        for master, _ in terminals:
            os.close(master)
        raise
    finally:
        for _, slave in terminals:
            os.close(slave)
    for fd, (master, _) in enumerate(terminals, 1):
        await loop.connect_read_pipe(
            functools.partial(_TerminalReader, protocol.on_data[fd]), os.fdopen(master, 'rb', 0))
    return transport, protocol


class ExecuteLocal(process.ProcessAction):
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
        sigterm_timeout: _base.SomeSubstitutionsType = _SIGTERM_TIMEOUT,
        sigkill_timeout: _base.SomeSubstitutionsType = _SIGKILL_TIMEOUT,
        emulate_tty: bool = False, output: Any = 'log',
        output_format: str = '[{this.process_description.final_name}] {line}',
        cached_output: bool = False, log_cmd: bool = False, on_exit: SomeReaction = None,
        respawn: bool | _base.SomeSubstitutionsType = False, respawn_delay: float | None = None,
        respawn_max_retries: int = -1, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.process_description = process_description
        self.shell = shell
        self.sigterm_timeout = normalize_to_list_of_substitutions(sigterm_timeout)
        self.sigkill_timeout = normalize_to_list_of_substitutions(sigkill_timeout)
        self.emulate_tty = emulate_tty
        output = os.environ.get('OVERRIDE_LAUNCH_PROCESS_OUTPUT', output)
        self.output: dict[str, Any] | list[_base.Substitution] = (
            output if isinstance(output, dict) else normalize_to_list_of_substitutions(output))
        self.__output_format = output_format
        self.__log_cmd = log_cmd
        self.__on_exit = on_exit
        self.__respawn = normalize_typed_substitution(respawn, bool)
        self.__respawn_delay = respawn_delay
        self.__respawn_max_retries = respawn_max_retries
        self.__respawn_retries = 0
        self.__process_event_args: dict[str, Any] | None = None
        self._subprocess_protocol: Protocol | None = None
        self._subprocess_transport: asyncio.SubprocessTransport | None = None
        self.__completed_future: asyncio.Future[None] | None = None
        self.__shutdown_future: asyncio.Future[None] | None = None
        self.__shutdown_timers: list[TimerAction] = []
        self.__stdout_buffer = _Output(cached_output)
        self.__stderr_buffer = _Output(cached_output)
        self.__executed = False

    @property
    def process_details(self) -> dict[str, Any] | None:
        return self.__process_event_args

    @property
    def return_code(self) -> int | None:
        """The exit status or minus the signal, None before."""
        if self._subprocess_transport is None:
            return None
        return self._subprocess_transport.get_returncode()

    def get_stdout(self) -> str:
        return self.__cached('stdout', self.__stdout_buffer)

    def get_stderr(self) -> str:
        return self.__cached('stderr', self.__stderr_buffer)

    def __cached(self, name: str, output: _Output) -> str:
        if output.text is None:
            raise RuntimeError(f'cached output must be true to be able to get {name}, '
                               f"proc '{self.process_description.name}'")
        return output.text

    def get_sub_entities(self) -> _base.Entities:
        return self.__on_exit if isinstance(self.__on_exit, list) else []

    def _shutdown_process(
        self, context: LaunchContext, *, send_sigint: bool
    ) -> _base.Entities | None:
        if self.__shutdown_future is None or self.__shutdown_future.done():
            return None
        if self.__completed_future is None or self.__completed_future.done():
            self.__shutdown_future.set_result(None)
            return None
        if self.__process_event_args is None or self._subprocess_transport is None:
            # It is being started: shut it down as soon as it runs.
            context.register_event_handler(OnProcessStart(
                on_start=lambda event, context: self._shutdown_process(
                    context, send_sigint=send_sigint)))
            return None
        self.__shutdown_future.set_result(None)
        context.extend_locals({'process_name': self.__process_event_args['name']})
        both = PythonExpression((
            'float(', *self.sigterm_timeout, ') + float(', *self.sigkill_timeout, ')'))
        self.__shutdown_timers = [self.__escalate(self.sigterm_timeout, 'SIGINT', 'SIGTERM'),
                                  self.__escalate([both], 'SIGTERM', 'SIGKILL')]
        actions: _base.Entities = [*self.__shutdown_timers]
        if send_sigint:
            actions.append(EmitEvent(event=process.SignalProcess(
                signal_number=signal.SIGINT, process_matcher=matches_action(self))))
        return actions

    def __escalate(
        self, period: list[_base.Substitution], received: str, name: str
    ) -> TimerAction:
        def report(context: LaunchContext) -> None:
            seconds = perform_substitutions(context, period)
            self.__logger.error(
                f"process[{context.locals.process_name}] failed to terminate '{seconds}' "
                f"seconds after receiving '{received}', escalating to '{name}'")

        event = process.SignalProcess(signal_number=name, process_matcher=matches_action(self))
        return TimerAction(
            period=period, cancel_on_shutdown=False,
            actions=[OpaqueFunction(function=report), EmitEvent(event=event)])

    def __on_shutdown(self, event: Any, context: LaunchContext) -> _base.Entities | None:
        # A terminal sends SIGINT to the process too.
        interrupted = event.due_to_sigint and not context.noninteractive
        return self._shutdown_process(context, send_sigint=not interrupted)

    def __on_shutdown_process_event(self, context: LaunchContext) -> _base.Entities | None:
        if not context.locals.event.process_matcher(self):
            return None
        return self._shutdown_process(context, send_sigint=True)

    def __on_signal_process_event(self, context: LaunchContext) -> None:
        event = context.locals.event
        if not event.process_matcher(self):
            return
        if (self.__process_event_args is None or self._subprocess_transport is None
                or self._subprocess_protocol is None):
            raise RuntimeError('Signal event received before subprocess transport available.')
        name = self.__process_event_args['name']
        if self._subprocess_protocol.complete.done():
            return
        self.__logger.info(f"sending signal '{event.signal_name}' to process[{name}]")
        with contextlib.suppress(ProcessLookupError):
            self._subprocess_transport.send_signal(signal.Signals[event.signal_name])

    def __log(self, logger: logging.Logger, lines: Iterator[str]) -> None:
        for line in lines:
            logger.info(self.__output_format.format(line=line, this=self))

    def __flush_buffers(self, event: _base.Event, context: LaunchContext) -> None:
        ended = self.__shutdown_future is None or self.__shutdown_future.done()
        self.__log(self.__stdout_logger, self.__stdout_buffer.rest(ended))
        self.__log(self.__stderr_logger, self.__stderr_buffer.rest(ended))

    async def __execute_process(self, context: LaunchContext) -> None:
        details = self.__process_event_args
        assert details is not None
        cmd, cwd, env = details['cmd'], details['cwd'], details['env']
        words = ' '.join(word for word in cmd if word.strip())
        if self.__log_cmd:
            self.__logger.info(
                f"process details: cmd='{words}', cwd='{cwd}', custom_env?={env is not None}")
        emulate_tty = self.emulate_tty
        if 'emulate_tty' in context.launch_configurations:
            emulate_tty = evaluate_condition_expression(
                context, normalize_to_list_of_substitutions(
                    context.launch_configurations['emulate_tty']))

        def on_start(pid: int) -> None:
            self.__logger.info(f'process started with pid [{pid}]')
            details['pid'] = pid

        def on_data(kind: type[process.ProcessIO], data: bytes) -> None:
            context.emit_event_sync(kind(text=data, **details))

        try:
            transport, protocol = await _start_process(
                lambda: Protocol(on_start, {
                    1: functools.partial(on_data, process.ProcessStdout),
                    2: functools.partial(on_data, process.ProcessStderr)}),
                cmd=cmd, cwd=cwd, env=env, shell=self.shell, emulate_tty=emulate_tty)
        except Exception:  # noqa: BLE001 - The launch goes on without this process.
            self.__logger.error(
                f'exception occurred while executing process:\n{traceback.format_exc()}')
            self.__cleanup()
            return
        self._subprocess_transport, self._subprocess_protocol = transport, protocol
        await context.emit_event(process.ProcessStarted(**details))
        returncode = await protocol.complete
        pid = transport.get_pid()
        if returncode == 0:
            self.__logger.info(f'process has finished cleanly [pid {pid}]')
        else:
            self.__logger.error(
                f"process has died [pid {pid}, exit code {returncode}, cmd '{words}'].")
        await context.emit_event(process.ProcessExited(returncode=returncode, **details))
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
        for timer in self.__shutdown_timers:
            timer.cancel()
        if self._subprocess_transport is not None:
            self._subprocess_transport.close()
        assert self.__completed_future is not None
        if not self.__completed_future.done():
            self.__completed_future.set_result(None)

    def prepare(self, context: LaunchContext) -> None:
        description = self.process_description
        description.prepare(context, self)
        self.__process_event_args = {
            'action': self, 'name': description.final_name, 'cmd': description.final_cmd,
            'cwd': description.final_cwd, 'env': description.final_env}
        self.__respawn = perform_typed_substitution(context, self.__respawn, bool)

    def execute(self, context: LaunchContext) -> _base.Entities | None:
        """
        Start the process, in the background.

        :raises RuntimeError: if the action was executed before.
        """
        self.prepare(context)
        name = self.process_description.final_name
        assert name is not None
        if self.__executed:
            raise RuntimeError(
                f"ExecuteLocal action '{name}': executed more than once: {self.describe()}")
        self.__executed = True
        if context.is_shutdown:
            # A process started now would miss the shutdown.
            return None

        self.__completed_future = context.asyncio_loop.create_future()
        self.__shutdown_future = context.asyncio_loop.create_future()
        self.__logger = launch.logging.get_logger(name)
        output = self.output if isinstance(self.output, dict) else (
            perform_substitutions(context, self.output))
        self.__stdout_logger, self.__stderr_logger = (
            launch.logging.get_output_loggers(name, output))
        handlers: list[_base.BaseEventHandler] = [
            _base.EventHandler(
                matcher=lambda event: isinstance(event, process.ShutdownProcess),
                entities=OpaqueFunction(function=self.__on_shutdown_process_event)),
            _base.EventHandler(
                matcher=lambda event: isinstance(event, process.SignalProcess),
                entities=OpaqueFunction(function=self.__on_signal_process_event)),
            OnProcessIO(
                target_action=self, on_stdout=lambda event: self.__log(
                    self.__stdout_logger, self.__stdout_buffer.lines(event.text)),
                on_stderr=lambda event: self.__log(
                    self.__stderr_logger, self.__stderr_buffer.lines(event.text))),
            OnShutdown(on_shutdown=self.__on_shutdown),
            OnProcessExit(target_action=self, on_exit=self.__on_exit),
            OnProcessExit(target_action=self, on_exit=self.__flush_buffers),
        ]
        for handler in handlers:
            context.register_event_handler(handler)
        context.asyncio_loop.create_task(self.__execute_process(context))
        return None

    def get_asyncio_future(self) -> asyncio.Future[None] | None:
        return self.__completed_future
