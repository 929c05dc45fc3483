# SPDX-License-Identifier: Apache-2.0
"""Executors wait for work and do it."""

from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
import inspect
import os
import sys
import threading
import time
from types import TracebackType
from typing import Any, TYPE_CHECKING
import warnings

from rclpy import _dds
from rclpy._entity import Entity, Work
from rclpy.context import Context
from rclpy.task import Future, Task
from rclpy.timer import Timer
from rclpy.utilities import get_default_context

if TYPE_CHECKING:
    from rclpy.node import Node

_FOREVER = 2 ** 62
_YIELDED = 5_000_000  # ns until a coroutine that gave way without a future goes on


class TimeoutException(Exception):
    """The time is over."""


class ShutdownException(Exception):
    """The executor has been shut down."""


class ExternalShutdownException(Exception):
    """The context has been shut down."""

    def __init__(self) -> None:
        super().__init__('The context has been shut down')


class ConditionReachedException(Exception):
    """The future is done."""


class Executor(AbstractContextManager['Executor']):
    """
    The base of executors.

    One wait set holds what the nodes' entities are triggered by; it changes only when entities
    come and go, or when a callback group lets none of its callbacks in.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__()
        self._context = get_default_context() if context is None else context
        self._nodes: list[Node] = []
        self._nodes_lock = threading.RLock()
        self._tasks: deque[Task] = deque()
        self._running = 0
        self._work = threading.Condition()
        self._is_shutdown = False
        self._guard = _dds.Guard()
        self._waiting = _dds.WaitSet()
        self._stale = True  # the wait set doesn't hold what it should
        self._by_handle: dict[int, list[Entity]] = {}
        self._timers: list[Timer] = []
        self._ready: deque[Entity] = deque()
        self._context._wakers.add(self._guard.trigger)

    @property
    def context(self) -> Context:
        """Its context."""
        return self._context

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Task:
        """Have a function or a coroutine executed; the task is a future."""
        task = Task(callback, args, kwargs, executor=self)
        self._tasks.append(task)
        self._guard.trigger()
        return task

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """
        Execute no more callbacks, and wait for those that are running.

        :returns: False if the time was over first.
        """
        if not self._is_shutdown:
            self._is_shutdown = True
            self._guard.trigger()
        limit = None if timeout_sec is None or timeout_sec < 0 else timeout_sec
        with self._work:
            own = getattr(_executing, 'depth', 0)
            if not self._work.wait_for(lambda: self._running <= own, limit):
                return False
        with self._nodes_lock:
            for node in self._nodes:
                node._forget_executor(self)
            self._nodes = []
        self._context._wakers.discard(self._guard.trigger)
        self._ready.clear()
        self._tasks.clear()
        return True

    def __del__(self, is_finalizing: Callable[[], bool] = sys.is_finalizing) -> None:
        # at the interpreter's end what this calls may be gone, and with the process all goes
        if hasattr(self, '_waiting') and not is_finalizing():
            self._context._wakers.discard(self._guard.trigger)
            self._waiting.close()
            self._guard.close()

    def add_node(self, node: 'Node') -> bool:
        """Execute the callbacks of a node; False if that is so already."""
        with self._nodes_lock:
            if node in self._nodes:
                return False
            self._nodes.append(node)
        node.executor = self
        self.wake()
        return True

    def remove_node(self, node: 'Node') -> None:
        """Execute the callbacks of a node no more."""
        with self._nodes_lock:
            if node in self._nodes:
                self._nodes.remove(node)
                node._forget_executor(self)
                self.wake()

    def wake(self) -> None:
        """Look again at what there is to wait for."""
        self._stale = True
        self._guard.trigger()

    def get_nodes(self) -> list['Node']:
        """List the nodes."""
        with self._nodes_lock:
            return list(self._nodes)

    def spin(self) -> None:
        """Execute callbacks until shutdown."""
        while self._context.ok() and not self._is_shutdown:
            self.spin_once()

    def spin_until_future_complete(self, future: Future,
                                   timeout_sec: float | None = None) -> None:
        """Execute callbacks until a future is done, or the time is over."""
        future._wake_when_done(self.wake)
        limit = None if timeout_sec is None or timeout_sec < 0 \
            else time.monotonic() + timeout_sec
        while self._context.ok() and not future.done() and not self._is_shutdown:
            left = None if limit is None else max(limit - time.monotonic(), 0.0)
            self.spin_once_until_future_complete(future, left)
            if limit is not None and time.monotonic() >= limit:
                return

    def _once(self, timeout_sec: float | None, condition: Callable[[], bool] | None) -> None:
        raise NotImplementedError()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for one callback and execute it; none or negative: without limit."""
        self._once(timeout_sec, None)

    def spin_once_until_future_complete(self, future: Future,
                                        timeout_sec: float | None = None) -> None:
        """Wait for one callback and execute it, or until a future is done."""
        future._wake_when_done(self.wake)
        self._once(timeout_sec, future.done)

    # --- waiting ---

    def _renew(self) -> None:
        """Let the wait set hold what may be executed now."""
        self._stale = False
        by_handle: dict[int, list[Entity]] = {}
        timers: list[Timer] = []
        with self._nodes_lock:
            for node in self._nodes:
                for entity in node._entities():
                    if not entity.callback_group.can_execute(entity):
                        self._stale = True  # a group may change its mind without a word
                        continue
                    if isinstance(entity, Timer):
                        timers.append(entity)
                    elif (handle := entity._handle()) is not None:
                        by_handle.setdefault(handle, []).append(entity)
        self._by_handle, self._timers = by_handle, timers
        handles = {self._guard.handle, *by_handle}
        graph = self._context._graph
        if graph is not None:
            handles.add(graph.condition)
        self._waiting.attach(handles)

    def _sleep(self, limit: int) -> None:
        """Wait for limit ns, or until something may be ready, and note what is."""
        if self._stale:
            self._renew()
        left = limit
        for timer in self._timers:
            until = timer._left()
            if until is not None and until < left:
                left = until
        triggered = self._waiting.wait(left)
        self._ready.extend(timer for timer in self._timers if timer.is_ready())
        for handle in triggered:
            if handle == self._guard.handle:
                self._guard.take()
                continue
            found = self._by_handle.get(handle)
            if found is not None:
                self._ready.extend(entity for entity in found if entity._is_triggered())
            elif self._context._graph is not None:
                self._context._graph.update()

    def _next(self, timeout_sec: float | None,
              condition: Callable[[], bool] | None) -> tuple[Any, Work | None]:
        """
        Wait for something to do: an entity and its work, or a task and None.

        :raises TimeoutException: when the time is over.
        :raises ShutdownException: when the executor is shut down.
        :raises ExternalShutdownException: when the context is shut down.
        :raises ConditionReachedException: when the condition holds.
        """
        limit = None if timeout_sec is None or timeout_sec < 0 \
            else time.monotonic_ns() + int(timeout_sec * 1e9)
        waited = False
        while True:
            if self._is_shutdown:
                raise ShutdownException()
            if not self._context.ok():
                raise ExternalShutdownException()
            if condition is not None and condition():
                raise ConditionReachedException()
            for _ in range(len(self._tasks)):
                task = self._tasks.popleft()
                if task.done():
                    continue
                if task._is_blocked() or task._has_yielded or task.executing():
                    self._tasks.append(task)
                    continue
                return task, None
            while self._ready:
                entity = self._ready.popleft()
                group = entity.callback_group
                if not group.beginning_execution(entity):
                    self._stale = True
                    continue
                work = entity._take(self)
                if work is not None:
                    return entity, work
                group.ending_execution(entity)
            left = _FOREVER if limit is None else limit - time.monotonic_ns()
            if left <= 0 and waited:
                raise TimeoutException()
            yielded = [task for task in self._tasks if task._has_yielded]
            self._sleep(max(min(left, _YIELDED), 0) if yielded else max(left, 0))
            for task in yielded:
                task._has_yielded = False
            waited = True

    def wait_for_ready_callbacks(
            self, timeout_sec: float | None = None, nodes: 'list[Node] | None' = None,
            condition: Callable[[], bool] = lambda: False) -> tuple[Task, Any, 'Node | None']:
        """
        Wait for something to do, for executors of one's own: a task to call, its entity and node.

        :raises TimeoutException: when the time is over.
        :raises ShutdownException: when the executor is shut down.
        :raises ExternalShutdownException: when the context is shut down.
        :raises ConditionReachedException: when the condition holds.
        """
        found, work = self._next(timeout_sec, condition)
        if work is None:
            return found, None, None
        owner = next((node for node in self.get_nodes() if found in node._entities()), None)
        return Task(self._execute, (found, work), executor=self), found, owner

    # --- executing ---

    def _begin(self) -> None:
        with self._work:
            self._running += 1
        _executing.depth = getattr(_executing, 'depth', 0) + 1

    def _end(self) -> None:
        _executing.depth -= 1
        with self._work:
            self._running -= 1
            self._work.notify_all()

    def _execute(self, entity: Any, work: Work | None) -> None:
        """Run a task, or a callback; an exception of a callback is raised."""
        self._begin()
        try:
            if work is None:
                self._run_task(entity)
                return
            callback, arguments, finish = work
            if inspect.iscoroutinefunction(callback):
                self._run_task(Task(self._coroutine, (entity, callback, arguments, finish),
                                    executor=self))
                return
            try:
                result = callback(*arguments)
                if finish is not None:
                    finish(result)
            finally:
                entity.callback_group.ending_execution(entity)
        finally:
            self._end()

    async def _coroutine(self, entity: Entity, callback: Callable[..., Any],
                         arguments: tuple[Any, ...],
                         finish: Callable[[Any], None] | None) -> None:
        try:
            result = await callback(*arguments)
            if finish is not None:
                finish(result)
        finally:
            entity.callback_group.ending_execution(entity)
            self._stale = True

    def _run_task(self, task: Task) -> None:
        task()
        if not task.done():
            self._stale = True  # its callback group stays closed meanwhile
            self._tasks.append(task)
        elif (error := task._exception) is not None:
            task.exception()
            raise error

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.shutdown()


_executing = threading.local()  # how many callbacks deep this thread is


class SingleThreadedExecutor(Executor):
    """Executes callbacks in the thread that spins."""

    def _once(self, timeout_sec: float | None, condition: Callable[[], bool] | None) -> None:
        try:
            found, work = self._next(timeout_sec, condition)
        except (ShutdownException, TimeoutException, ConditionReachedException):
            return
        self._execute(found, work)


class MultiThreadedExecutor(Executor):
    """
    Executes callbacks in a pool of threads.

    :param num_threads: how many; by default as many as the process may use processors.
    """

    def __init__(self, num_threads: int | None = None, *,
                 context: Context | None = None) -> None:
        super().__init__(context=context)
        from concurrent.futures import Future as Submitted
        from concurrent.futures import ThreadPoolExecutor
        if num_threads is None:
            num_threads = len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') \
                else os.cpu_count() or 2
        if num_threads == 1:
            warnings.warn('MultiThreadedExecutor is used with a single thread.\n'
                          'Use the SingleThreadedExecutor instead.', stacklevel=2)
        self._submitted: list[Submitted[None]] = []
        self._executor = ThreadPoolExecutor(num_threads)

    def _in_thread(self, found: Any, work: Work | None) -> None:
        try:
            self._execute(found, work)
        finally:
            self.wake()

    def _once(self, timeout_sec: float | None, condition: Callable[[], bool] | None) -> None:
        def finished() -> bool:
            return condition is not None and condition() \
                or any(future.done() for future in self._submitted)

        try:
            found, work = self._next(timeout_sec, finished)
        except ConditionReachedException:
            pass
        except (ExternalShutdownException, ShutdownException, TimeoutException):
            return
        else:
            self._stale = True  # what runs now isn't to be waited for
            self._submitted.append(self._executor.submit(self._in_thread, found, work))
        for future in [future for future in self._submitted if future.done()]:
            self._submitted.remove(future)
            future.result()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Execute no more callbacks, and wait for those that are running."""
        done = super().shutdown(timeout_sec)
        if done:
            self._executor.shutdown(wait=False)
        return done
