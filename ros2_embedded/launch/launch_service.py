# SPDX-License-Identifier: Apache-2.0
"""Runs launch descriptions in an event loop."""
from __future__ import annotations

import asyncio
import collections.abc
import contextlib
import logging
import signal
import threading
from typing import Any, Coroutine, Iterable, Iterator
import warnings

import launch.logging

from ._base import Event, LaunchDescriptionEntity
from .event_handlers import OnIncludeLaunchDescription, OnShutdown
from .events import IncludeLaunchDescription, Shutdown
from .launch_context import LaunchContext
from .launch_description import LaunchDescription
from .utilities import AsyncSafeSignalManager, visit_all_entities_and_collect_futures

Loop = asyncio.AbstractEventLoop
Waiting = Coroutine[Any, Any, None]


def _get_loop() -> Loop:
    """Return this thread's event loop, made if need be."""
    with warnings.catch_warnings(), contextlib.suppress(RuntimeError):
        # Python 3.12 warns of what 3.14 refuses: to make a loop that was never set.
        warnings.simplefilter('ignore', DeprecationWarning)
        loop = asyncio.get_event_loop()
        if not loop.is_closed():
            return loop
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    return loop


class LaunchService:
    """
    Handles events until there is nothing more to do.

    :param argv: command line arguments, for the context.
    :param noninteractive: whether SIGINT has to be passed on to the processes, because no
        terminal does it.
    :param debug: whether to log from level DEBUG on.
    """

    def __init__(
        self, *, argv: Iterable[str] | None = None, noninteractive: bool = False,
        debug: bool = False
    ) -> None:
        launch.logging.launch_config.level = logging.DEBUG if debug else logging.INFO
        self.__logger = launch.logging.get_logger('launch')
        self.__context = LaunchContext(argv=argv, noninteractive=noninteractive)
        self.__context.register_event_handler(OnIncludeLaunchDescription())
        self.__context.register_event_handler(OnShutdown(on_shutdown=self.__on_shutdown))
        self._entity_future_pairs: list[
            tuple[LaunchDescriptionEntity, asyncio.Future[Any]]] = []
        self.__loop_lock = threading.RLock()
        self.__loop: Loop | None = None
        self.__task: asyncio.Task[Any] | None = None
        self.__shutting_down = False
        self.__return_code = 0

    def emit_event(self, event: Event) -> None:
        """Queue an event, from any thread but the loop's; before running too."""
        with self.__loop_lock:
            if self.__loop is None:
                self.__context.emit_event_sync(event)
                return
            future = asyncio.run_coroutine_threadsafe(
                self.__context.emit_event(event), self.__loop)
        future.result()

    def include_launch_description(self, launch_description: LaunchDescription) -> None:
        """Have a launch description visited."""
        self.emit_event(IncludeLaunchDescription(launch_description))

    def _is_idle(self) -> bool:
        self._entity_future_pairs = [
            pair for pair in self._entity_future_pairs if not pair[1].done()]
        self.__context._completion_futures = [
            future for future in self.__context._completion_futures if not future.done()]
        return not (
            self._entity_future_pairs or self.__context._completion_futures
            or not self.__context._event_queue.empty())

    @contextlib.contextmanager
    def _prepare_run_loop(self) -> Iterator[Loop]:
        try:
            with self.__loop_lock:
                if self.__loop is not None:
                    raise RuntimeError('LaunchService cannot be run multiple times concurrently.')
                loop = _get_loop()
                self.__context.asyncio_loop = loop
                # A queue belongs to the loop that it was first waited for in.
                before, queue = self.__context._event_queue, asyncio.Queue[Event]()
                while not before.empty():
                    queue.put_nowait(before.get_nowait())
                self.__context._event_queue = queue
                self.__loop = loop
            task = asyncio.current_task(loop)
            assert task is not None
            self.__task = task
            interrupted = False

            def on_sigint(number: int) -> None:
                nonlocal interrupted
                text = 'user interrupted with ctrl-c (SIGINT)'
                if interrupted:
                    self.__logger.warning(f'{text} again, ignoring...')
                    return
                self.__logger.warning(text)
                self._shutdown(reason='ctrl-c (SIGINT)', due_to_sigint=True, force_sync=True)
                interrupted = True

            def on_sigterm(number: int) -> None:
                name = signal.Signals(number).name
                self.__logger.error(f'user interrupted with ctrl-\\ ({name}), terminating...')
                self.__logger.error(f'using {name} can result in orphaned processes')
                self.__logger.error('make sure no processes launched are still running')
                loop.call_soon(task.cancel)

            with AsyncSafeSignalManager(loop) as manager:
                # Nothing here changes a signal's disposition: by default SIGTERM and SIGQUIT
                # end the process before any callback runs, and Python raises
                # KeyboardInterrupt for SIGINT beside the callback.
                manager.handle(signal.SIGINT, on_sigint)
                manager.handle(signal.SIGTERM, on_sigterm)
                manager.handle(signal.SIGQUIT, on_sigterm)
                yield loop
        finally:
            with self.__loop_lock:
                self.__context.asyncio_loop = None
                self.__loop = None
                self.__shutting_down = False

    async def _process_one_event(self) -> None:
        event = await self.__context._event_queue.get()
        self.__logger.debug(f"processing event: '{event}'")
        for handler in tuple(self.__context._event_handlers):
            if not handler.matches(event):
                continue
            self.__logger.debug(f"processing event: '{event}' ✓ '{handler}'")
            self.__context._push_locals()
            entities = handler.handle(event, self.__context)
            if not isinstance(entities, collections.abc.Iterable):
                entities = (entities,)
            for entity in entities:
                if entity is None:
                    continue
                if not isinstance(entity, LaunchDescriptionEntity):
                    raise RuntimeError(
                        f"expected a LaunchDescriptionEntity from event_handler, got '{entity}'")
                self._entity_future_pairs.extend(
                    visit_all_entities_and_collect_futures(entity, self.__context))
            self.__context._pop_locals()

    async def run_async(self, *, shutdown_when_idle: bool = True) -> int:
        """
        Handle events until shut down, by default also when idle.

        :return: 0, or 1 if an exception was raised or the task cancelled.
        :raises RuntimeError: outside of the main thread, or while running.
        """
        if threading.current_thread() is not threading.main_thread():
            raise RuntimeError('LaunchService can only be run in the main thread.')
        self.__return_code = 0
        with self._prepare_run_loop() as loop:
            launch.logging.log_launch_config(logger=self.__logger)
            loop.set_exception_handler(self.__on_loop_exception)
            event_task: asyncio.Task[None] | None = None
            while True:
                try:
                    idle = self._is_idle()
                    if idle and self.__shutting_down:
                        if event_task is not None:
                            event_task.cancel()
                        return self.__return_code
                    if idle and shutdown_when_idle:
                        await self.__shutdown_and_wait('idle')
                        continue
                    if event_task is None or event_task.done():
                        event_task = loop.create_task(self._process_one_event())
                    awaited: list[asyncio.Future[Any]] = [event_task]
                    if self.__context._event_queue.empty():
                        awaited += [future for _, future in self._entity_future_pairs]
                        awaited += self.__context._completion_futures
                    done, _ = await asyncio.wait(
                        awaited, return_when=asyncio.FIRST_COMPLETED)
                    for future in done:
                        future.result()
                except KeyboardInterrupt:
                    continue
                except asyncio.CancelledError:
                    self.__logger.error('run task was canceled')
                    return 1
                except Exception as exc:
                    text = f'Caught exception in launch (see debug for traceback): {exc}'
                    self.__logger.debug('', exc_info=True)
                    self.__logger.error(text)
                    await self.__shutdown_and_wait(text)
                    self.__return_code = 1

    def __on_loop_exception(self, loop: Loop, context: dict[str, Any]) -> None:
        self.__return_code = 1
        loop.default_exception_handler(context)

    def run(self, *, shutdown_when_idle: bool = True) -> int:
        """Run as :meth:`run_async` does, and block meanwhile."""
        loop = _get_loop()
        task = loop.create_task(self.run_async(shutdown_when_idle=shutdown_when_idle))
        while True:
            try:
                return loop.run_until_complete(task)
            except KeyboardInterrupt:
                # The shutdown is under way, see on_sigint.
                continue

    def __on_shutdown(self, event: Event, context: LaunchContext) -> None:
        self.__shutting_down = True
        self.__context._set_is_shutdown(True)

    async def __shutdown_and_wait(self, reason: str) -> None:
        waiting = self._shutdown(reason=reason, due_to_sigint=False)
        if waiting is not None:
            await waiting

    def _shutdown(
        self, *, reason: str, due_to_sigint: bool, force_sync: bool = False
    ) -> Waiting | None:
        waiting: Waiting | None = None
        if not self.__shutting_down:
            event = Shutdown(reason=reason, due_to_sigint=due_to_sigint)
            if force_sync:
                self.__context.emit_event_sync(event)
            elif threading.current_thread() is threading.main_thread():  # the loop's
                waiting = self.__context.emit_event(event)
            else:
                self.emit_event(event)
        self.__shutting_down = True
        self.__context._set_is_shutdown(True)
        return waiting

    def shutdown(self, force_sync: bool = False) -> Waiting | None:
        """
        Shut down, if running.

        :param force_sync: queue the event at once, in the loop's thread.
        :return: what to await, when called in the loop's thread without ``force_sync``.
        """
        with self.__loop_lock:
            if self.__loop is None:
                return None
            return self._shutdown(
                reason='LaunchService.shutdown() called', due_to_sigint=False,
                force_sync=force_sync)

    @property
    def context(self) -> LaunchContext:
        """The context of all that runs here."""
        return self.__context

    @property
    def event_loop(self) -> Loop | None:
        """The loop, while running."""
        return self.__loop

    @property
    def task(self) -> asyncio.Task[Any] | None:
        """The task of :meth:`run_async`."""
        return self.__task
