# SPDX-License-Identifier: Apache-2.0
"""Futures, and tasks that an executor runs."""

from collections.abc import Callable, Generator
import inspect
import sys
import threading
from typing import Any
import warnings
import weakref


class Future:
    """A result that will be there, or an exception."""

    def __init__(self, *, executor: Any = None) -> None:
        self._done = False
        self._cancelled = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._exception_fetched = False
        self._callbacks: list[Callable[[Any], Any]] = []
        self._wakers: list[Callable[[], None]] = []  # of tasks that await it
        self._lock = threading.Lock()
        self._executor: Any = None
        self._set_executor(executor)

    def __del__(self) -> None:
        if self._exception is not None and not self._exception_fetched:
            print(f'The following exception was never retrieved: {self._exception}',
                  file=sys.stderr)

    def __await__(self) -> Generator['Future', None, Any]:
        while not self._done:
            yield self
        return self.result()

    def cancel(self) -> None:
        """Ask for its cancellation unless it is done."""
        with self._lock:
            if not self._done:
                self._cancelled = True
        self._settle()

    def cancelled(self) -> bool:
        """Say whether it was cancelled."""
        return self._cancelled

    def done(self) -> bool:
        """Say whether there is a result or an exception."""
        return self._done

    def result(self) -> Any:
        """Give the result; raise the exception if there is one; None while it isn't done."""
        if self._exception is not None:
            self._exception_fetched = True
            raise self._exception
        return self._result

    def exception(self) -> BaseException | None:
        """Give the exception."""
        self._exception_fetched = True
        return self._exception

    def set_result(self, result: Any) -> None:
        """Finish it with a result."""
        with self._lock:
            self._result, self._done, self._cancelled = result, True, False
        self._settle()

    def set_exception(self, exception: BaseException) -> None:
        """Finish it with an exception."""
        with self._lock:
            self._exception, self._exception_fetched = exception, False
            self._done, self._cancelled = True, False
        self._settle()

    def _settle(self) -> None:
        with self._lock:
            executor = self._executor()
            callbacks, self._callbacks = self._callbacks, []
            wakers, self._wakers = self._wakers, []
        for wake in wakers:
            wake()
        for callback in callbacks:
            if executor is not None:
                executor.create_task(callback, self)
                continue
            try:
                callback(self)
            except Exception as error:  # noqa: BLE001 - those after it are called, too
                warnings.warn(f'Unhandled exception in done callback: {error}', stacklevel=2)

    def _set_executor(self, executor: Any) -> None:
        with self._lock:
            self._executor = (lambda: None) if executor is None else weakref.ref(executor)

    def _wake_when_done(self, wake: Callable[[], None]) -> None:
        with self._lock:
            if not self._done:
                if wake not in self._wakers:
                    self._wakers.append(wake)
                return
        wake()

    def add_done_callback(self, callback: Callable[[Any], Any]) -> None:
        """Call this with the future when it is done, in its executor if it has one."""
        with self._lock:
            if not self._done:
                self._callbacks.append(callback)
                return
            executor = self._executor()
        if executor is not None:
            executor.create_task(callback, self)
        else:
            callback(self)


class Task(Future):
    """A function or a coroutine that an executor runs; only executors make these."""

    def __init__(self, handler: Any, args: Any = None, kwargs: Any = None,
                 executor: Any = None) -> None:
        super().__init__(executor=executor)
        args, kwargs = args or (), kwargs or {}
        if inspect.iscoroutinefunction(handler):
            handler = handler(*args, **kwargs)
        self._handler, self._args, self._kwargs = handler, args, kwargs
        self._executing = False
        self._task_lock = threading.Lock()
        self._awaited: Future | None = None
        self._has_yielded = False

    def _is_blocked(self) -> bool:
        return self._awaited is not None and not self._awaited.done()

    def __call__(self) -> None:
        """Run the function, or the coroutine up to where it has to wait."""
        if self._done or not self._task_lock.acquire(blocking=False):
            return
        try:
            if self._done:
                return
            self._executing = True
            try:
                if inspect.iscoroutine(self._handler):
                    self._step()
                else:
                    self.set_result(self._handler(*self._args, **self._kwargs))
            except Exception as error:  # noqa: BLE001 - raised where the result is asked for
                self.set_exception(error)
            finally:
                self._executing = False
            if self._done:
                self._handler = self._args = self._kwargs = None
        finally:
            self._task_lock.release()

    def _step(self) -> None:
        try:
            awaited = self._handler.send(None)
        except StopIteration as end:
            self.set_result(end.value)
            return
        self._awaited = awaited if isinstance(awaited, Future) else None
        self._has_yielded = self._awaited is None
        executor = self._executor()
        if self._awaited is not None and executor is not None:
            self._awaited._wake_when_done(executor.wake)

    def executing(self) -> bool:
        """Say whether it runs at this moment."""
        return self._executing
