# SPDX-License-Identifier: Apache-2.0
"""Letting a Ctrl-C through calls that block: the libraries below know nothing of it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
import threading
import time
from typing import Optional, TypeVar

from fogros2.errors import Cancelled, FogError

T = TypeVar('T')

#: Seconds that a call may go on after the cancel: what it makes is known then, and can be undone.
GRACE = 1.0


def cancellable(
    call: Callable[[], T], cancel: Optional[threading.Event], *, what: str,
    late: Optional[Callable[[T], None]] = None,
) -> T:
    """
    Return what ``call`` returns, or raise what it raises; given up soon after ``cancel`` is set.

    It then goes on in a thread of its own for as long as it likes, and nobody waits for it.

    :param call: raises FogErrors alone.
    :param late: gets what the call returns after it was given up.
    :raises Cancelled: it had not returned within ``GRACE`` seconds of the cancel.
    """
    if cancel is None:
        return call()
    answer: Future[T] = Future()
    lock = threading.Lock()
    given_up = False

    def run() -> None:
        try:
            value = call()
        except FogError as error:
            answer.set_exception(error)
            return
        with lock:
            answer.set_result(value)
            drop = given_up
        if drop and late is not None:
            late(value)

    thread = threading.Thread(target=run, name='fog-call', daemon=True)
    thread.start()
    until: Optional[float] = None
    while thread.is_alive() and not answer.done():
        thread.join(0.05)
        if until is None and cancel.is_set():
            until = time.monotonic() + GRACE
        if until is not None and time.monotonic() > until:
            with lock:
                given_up = not answer.done()
            if given_up:
                raise Cancelled(what)
    if not answer.done():
        # its traceback was printed by the thread
        raise AssertionError(f'{what} ended without an answer')
    return answer.result()


def cancelled(cancel: Optional[threading.Event], what: str) -> None:
    """
    Say whether to go on.

    :raises Cancelled: ``cancel`` is set.
    """
    if cancel is not None and cancel.is_set():
        raise Cancelled(what)
