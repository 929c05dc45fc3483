# SPDX-License-Identifier: Apache-2.0
"""
Give the other packages access to private parts of launch, and say why each is needed.

launch has no public extension point to start a process elsewhere. ``ExecuteLocal.execute``
resolves the action, registers its handlers and then creates a task from its private method
``__execute_process``. FogROS2 extends launch at that method: :func:`replace_methods` replaces it,
:func:`set_transport` sets ``_subprocess_transport`` and ``_subprocess_protocol``, and
:func:`delay_start` calls it later. Everything else (substitutions, handlers, output, ``on_exit``,
signals) stays launch's own code. The options that the method reads have no getters.

The names are those of Jazzy (launch 3.4), which the embedded default shares; the launches of
``test/launch`` use each of them.
"""

from __future__ import annotations

import asyncio
import collections
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Sequence
import contextlib
import functools
import signal
from typing import Any, NamedTuple, Optional, Union

from launch import (
    Event,
    LaunchContext,
    LaunchDescription,
    LaunchDescriptionEntity,
    LaunchDescriptionSource,
)
from launch.actions import ExecuteLocal, TimerAction
from launch.events import Shutdown
from launch.events.process import ProcessExited, ShutdownProcess
from launch.utilities import AsyncSafeSignalManager, visit_all_entities_and_collect_futures

#: The method of ExecuteLocal that starts the process and awaits its end.
EXECUTE_PROCESS = '_ExecuteLocal__execute_process'
#: The coroutine method of TimerAction that waits, then fires.
WAIT_TO_FIRE = '_wait_to_fire_event'

def option(action: ExecuteLocal, name: str) -> Any:
    """Return an option of a prepared action, such as ``respawn``; there are no getters."""
    return getattr(action, f'_ExecuteLocal__{name}')


def prefix_output(action: ExecuteLocal, machine: str, *, remove: bool = False) -> None:
    """Put the machine's name before the process's name in the output format, or remove it."""
    name = '{this.process_description.final_name}'
    # a machine's name contains no braces, so it is safe in a format string
    names = (name, f'{machine}.{name}')
    old, new = reversed(names) if remove else names
    vars(action)['_ExecuteLocal__output_format'] = option(
        action, 'output_format').replace(old, new)


def completed(action: ExecuteLocal) -> Optional[asyncio.Future[Any]]:
    """Return the future of the process's end, None before the action's execution."""
    future: Optional[asyncio.Future[Any]] = option(action, 'completed_future')
    return future


def set_transport(action: ExecuteLocal, process: object) -> None:
    """
    Make an action use ``process`` as its subprocess.

    launch calls ``send_signal``, ``kill``, ``get_returncode`` and reads ``complete``.
    """
    vars(action).update(_subprocess_transport=process, _subprocess_protocol=process)


def transport(action: ExecuteLocal) -> Any:
    """Return the object that the action uses as its subprocess, None if there is none yet."""
    return action._subprocess_transport


class Methods(NamedTuple):
    """
    What launch calls of a process action.

    :param start: starts the process, and awaits its end.
    :param shut_down: takes the context and, by keyword, ``send_sigint``.
    """

    execute: Callable[[LaunchContext], Optional[list[LaunchDescriptionEntity]]]
    prepare: Callable[[LaunchContext], None]
    start: Callable[[LaunchContext], Coroutine[Any, Any, None]]
    shut_down: Callable[..., Optional[list[LaunchDescriptionEntity]]]


def replace_methods(action: ExecuteLocal, methods: Methods) -> Methods:
    """Make launch call other methods in place of an action's own; return its own."""
    names = ('execute', 'prepare', EXECUTE_PROCESS, '_shutdown_process')
    own = Methods(*(getattr(action, name) for name in names))
    vars(action).update(zip(names, methods))
    return own


def change_command(
    action: ExecuteLocal, change: Callable[[Sequence[str]], Sequence[str]],
) -> None:
    """Have a process action run a changed command line, once it is resolved."""
    prepare = action.prepare

    def prepared(context: LaunchContext) -> None:
        prepare(context)
        details = action.process_details
        assert details is not None
        details['cmd'] = [*change(details['cmd'])]

    vars(action)['prepare'] = prepared


class Stay:
    """
    The stay of a remote process on the robot, which :meth:`leave` ends without launch's notice.

    Its process uses it as the launch's context.
    """

    def __init__(self, action: ExecuteLocal, context: LaunchContext) -> None:
        self._action = action
        self._context = context
        self._leaving = False

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the launch's context."""
        return getattr(self._context, name)

    @property
    def is_shutdown(self) -> bool:
        """Whether the process must not start again."""
        return self._leaving or self._context.is_shutdown

    async def emit_event(self, event: Event) -> None:
        """Emit an event, except for the end of a process that continues elsewhere."""
        if not (self._leaving and isinstance(event, ProcessExited)):
            await self._context.emit_event(event)

    async def leave(self, sigterm_timeout: float, sigkill_timeout: float) -> None:
        """End the process by SIGINT, SIGTERM and SIGKILL; launch still waits for its end."""
        ended: asyncio.Future[None] = self._context.asyncio_loop.create_future()
        before = completed(self._action)
        assert before is not None
        self._leaving = True
        vars(self._action)['_ExecuteLocal__completed_future'] = ended
        for number, seconds in ((signal.SIGINT, sigterm_timeout),
                                (signal.SIGTERM, sigkill_timeout), (signal.SIGKILL, None)):
            with contextlib.suppress(ProcessLookupError):
                if transport(self._action) is not None:
                    transport(self._action).send_signal(number)
            if (await asyncio.wait({ended}, timeout=seconds))[0]:
                break
        vars(self._action)['_ExecuteLocal__completed_future'] = before
        if self._context.is_shutdown and not before.done():
            before.set_result(None)


def delay_start(
    entity: Union[ExecuteLocal, TimerAction], until: Callable[[], Awaitable[bool]],
) -> None:
    """
    Delay the start of a process, or of a timer's period.

    :param until: awaited first; if it returns False, the process never starts.
    """
    method = EXECUTE_PROCESS if isinstance(entity, ExecuteLocal) else WAIT_TO_FIRE
    start = getattr(entity, method)

    async def start_later(context: LaunchContext) -> None:
        begins = await until()
        if isinstance(entity, TimerAction) or begins and not context.is_shutdown:
            await start(context)
            return
        future = completed(entity)
        if future is not None and not future.done():
            future.set_result(None)

    setattr(entity, method, start_later)


def replace_reader(
    source: LaunchDescriptionSource,
    reader: Callable[[Callable[[str], LaunchDescription], str], LaunchDescription],
) -> None:
    """
    Make a source of a launch description read its launch file by a function.

    :param reader: called with the function that read the file before, and the file's path.
    """
    vars(source)['_get_launch_description'] = functools.partial(
        reader, source._get_launch_description)


def kept_environments(context: LaunchContext) -> list[dict[str, str]]:
    """
    Return the saved environments that launch restores, so that callers can change them.

    A scoped group restores one at its end, ResetEnvironment another. Variables of the whole
    launch have to be in all of them.
    """
    environments: list[dict[str, str]] = []
    for name, value in vars(context).items():
        if 'environment' in name:
            environments += [kept for kept in (value if isinstance(value, list) else [value])
                             if isinstance(kept, dict)]
    return environments


def has_ros_node(context: LaunchContext) -> bool:
    """Return whether launch_ros has created its ROS node, as for lifecycle events."""
    return 'ros_adapter' in context.get_locals_as_dict()


def waiting_events(context: LaunchContext) -> int:
    """Return the number of events that launch has yet to process."""
    return int(context._event_queue.qsize())


def guard_shutdown(
    context: LaunchContext, failed: Callable[[BaseException], None],
) -> None:
    """
    Let all handlers of a shutdown run, although one of them fails, as one that prints may.

    launch passes an exception on and calls no further handler: the other processes, and the
    machines, would never hear of the shutdown.

    :param failed: called with the exception.
    """
    handlers = _Handlers(failed)
    for handler in context._event_handlers:
        handlers.append(handler)
    context._event_handlers = handlers


class _Handlers(collections.deque[Any]):
    """The handlers of a launch, each of which may fail at the shutdown."""

    def __init__(self, failed: Callable[[BaseException], None]) -> None:
        super().__init__()
        self._failed = failed

    def append(self, handler: Any) -> None:
        super().append(self._guarded(handler))

    def appendleft(self, handler: Any) -> None:
        super().appendleft(self._guarded(handler))

    def _guarded(self, handler: Any) -> Any:
        vars(handler)['handle'] = functools.partial(_handle_all, handler.handle, self._failed)
        return handler


def _handle_all(
    handle: Callable[[Event, LaunchContext], Any], failed: Callable[[BaseException], None],
    event: Event, context: LaunchContext,
) -> Any:
    if not isinstance(event, Shutdown):
        return handle(event, context)
    try:
        entities = handle(event, context)
        for entity in entities if isinstance(entities, Iterable) else (entities,):
            if entity is not None:
                for _, future in visit_all_entities_and_collect_futures(entity, context):
                    context.add_completion_future(future)
    except Exception as error:  # noqa: BLE001 - of a launch file's own function
        failed(error)
    return None


def signal_manager() -> Optional[AsyncSafeSignalManager]:
    """
    Return the signal manager of the running LaunchService.

    Its SIGTERM handler cancels the service at once; launch has no public way to replace it.
    """
    name = '_AsyncSafeSignalManager__current'
    manager: Optional[AsyncSafeSignalManager] = getattr(AsyncSafeSignalManager, name)
    return manager


class _Census(ShutdownProcess):
    """Collect every process action; shut down none."""

    def __init__(self, actions: list[ExecuteLocal]) -> None:
        def note(action: ExecuteLocal) -> bool:
            actions.append(action)
            return False  # this process is not to be shut down

        super().__init__(process_matcher=note)


def processes(context: LaunchContext) -> list[ExecuteLocal]:
    """
    Return every process action that was executed, the robot's own included.

    Each process action has a handler that asks an event's matcher about the action. The matcher
    of this event notes the action and does not match. The function calls the handlers itself,
    because the event queue would deliver the answer later.
    """
    actions: list[ExecuteLocal] = []
    census = _Census(actions)
    for handler in tuple(context._event_handlers):
        if handler.matches(census):
            context._push_locals()
            entities = handler.handle(census, context)
            for entity in entities if isinstance(entities, Iterable) else (entities,):
                if entity is not None:
                    entity.visit(context)
            context._pop_locals()
    return actions
