# SPDX-License-Identifier: Apache-2.0
"""Time-outs of a deployment, the only polling loops, and calls that a cancel abandons."""

from __future__ import annotations

import atexit
from collections.abc import Callable, Iterator
from concurrent import futures
import contextlib
import dataclasses
import sys
import threading
import time
from types import ModuleType
from typing import Optional, TypeVar

from fogros2.errors import Cancelled, DeadlineExceeded

T = TypeVar('T')
#: What each thread is doing, outermost first.
_doing: dict[int, list[str]] = {}
#: Seconds to wait for the answer to a sent request, which may create something, after a cancel.
ON_ITS_WAY = 15.0
#: Seconds for which the end of the process waits for an import.
_IMPORT = 5.0
#: Seconds for a machine to write its memory's files to a disk: 400 GB at 125 MB/s.
TO_DISK = 3600.0


@dataclasses.dataclass(frozen=True)
class Timeouts:
    """The time-out of each part of a deployment, in seconds; of a sync, without progress."""

    boot: float = 300.0
    ssh: float = 60.0
    install: float = 1800.0
    sync: float = 1800.0
    build: float = 3600.0
    vpn: float = 30.0
    agent: float = 30.0
    command: float = 60.0


@contextlib.contextmanager
def noted(what: str) -> Iterator[None]:
    """Note what this thread does or waits for, for those who look at a slow step."""
    mine = _doing.setdefault(threading.get_ident(), [])
    mine.append(what)
    try:
        yield
    finally:
        mine.pop()
        if not mine:
            _doing.pop(threading.get_ident(), None)


def doing(thread: int) -> str:
    """Return what a thread does or waits for, by its identifier; '' if it has not noted it."""
    return next(iter(_doing.get(thread, ())), '')


def everything() -> list[str]:
    """Return what the threads of this process do or wait for, each text once."""
    return list(dict.fromkeys(text for text in map(doing, list(_doing)) if text))


def wait_until(
    probe: Callable[[], Optional[T]],
    *,
    timeout: float,
    what: str,
    hint: str = '',
    cancel: Optional[threading.Event] = None,
    interval: float = 0.02,
    longest: float = 1.0,
    first: float = 0.0,
) -> T:
    """
    Call ``probe`` until it returns something other than None or False; return that value.

    The pauses grow from ``interval`` to ``longest`` (seconds): a fast machine is noticed at once,
    and a slow one gets few requests.

    :param what: completes 'timed out after 30 s waiting for ...'.
    :param first: seconds before the first call, if it cannot succeed at once.
    :raises DeadlineExceeded: after ``timeout`` seconds.
    :raises Cancelled: as soon as ``cancel`` is set.
    """
    deadline = time.monotonic() + timeout
    cancel = cancel or threading.Event()
    with noted(f'waiting for {what}'):
        cancel.wait(first)
        while True:
            if cancel.is_set():
                raise Cancelled(f'waiting for {what}')
            value = probe()
            if value is not None and value is not False:
                return value
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                raise DeadlineExceeded(f'timed out after {timeout:g} s waiting for {what}', hint)
            cancel.wait(min(interval, remaining))
            interval = min(interval * 1.5, longest)


class Periodic:
    """
    Call a function periodically in a thread, until ``close``.

    :param interval: seconds between a call's end and the next call.
    :param work: may return the seconds until its next call; it must not raise.
    :param first: seconds before the first call; ``interval`` if None.
    :param stop: event that ``close`` sets; it may be shared.
    """

    def __init__(
        self, name: str, interval: float, work: Callable[[], Optional[float]], *,
        first: Optional[float] = None, stop: Optional[threading.Event] = None,
    ) -> None:
        self._stop = stop or threading.Event()

        def run() -> None:
            pause = interval if first is None else first
            while not self._stop.wait(pause):
                pause = work() or interval

        threading.Thread(target=run, name=name, daemon=True).start()

    def close(self) -> None:
        """Stop the calls; one that is under way goes on."""
        self._stop.set()


def _await_imports() -> None:
    """
    Wait for imports of daemon threads at the end of the process.

    Rust aborts a process that ends a thread during the import of a module in Rust.
    """
    deadline = time.monotonic() + _IMPORT
    while time.monotonic() < deadline and any(
            getattr(getattr(module, '__spec__', None), '_initializing', False)
            for module in list(sys.modules.values()) if type(module) is ModuleType):
        time.sleep(0.01)


atexit.register(_await_imports)


def in_thread(call: Callable[[], T]) -> futures.Future[T]:
    """Run a call in a thread that does not keep the process; return its result to be."""
    answer: futures.Future[T] = futures.Future()

    def run() -> None:
        try:
            answer.set_result(call())
        except BaseException as error:  # noqa: BLE001 - its caller raises it again
            answer.set_exception(error)

    # no pool: at exit the interpreter would wait for its threads
    threading.Thread(target=run, name='fog-call', daemon=True).start()
    return answer


def cancellable(
    call: Callable[[], T], cancel: Optional[threading.Event], *, what: str,
    grace: Callable[[], float] = lambda: ON_ITS_WAY, late: Optional[Callable[[T], None]] = None,
) -> T:
    """
    Run a blocking call that a cancel abandons; return its result or raise its error.

    The call runs in a separate thread, which continues after a cancel.

    :param cancel: None to call in this thread.
    :param what: completes '... was cancelled'.
    :param grace: returns the seconds that the call gets after ``cancel`` is set; it may create
        a resource, which can be removed only when its id is known.
    :param late: receives the result of an abandoned call.
    :raises Cancelled: ``cancel`` was set before, or the call did not return in time.
    """
    if cancel is None:
        with noted(what):
            return call()
    if cancel.is_set():
        raise Cancelled(what)

    def pass_on(done: futures.Future[T]) -> None:
        if late is not None and done.exception() is None:
            late(done.result())

    answer = in_thread(call)
    until: Optional[float] = None
    with noted(what):
        while not futures.wait([answer], 0.05).done:
            if cancel.is_set():
                until = until or time.monotonic() + grace()
                if time.monotonic() >= until:
                    answer.add_done_callback(pass_on)
                    raise Cancelled(what)
    return answer.result()
