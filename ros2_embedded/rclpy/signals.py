# SPDX-License-Identifier: Apache-2.0
"""
SIGINT and SIGTERM shut all contexts down.

Python runs its handlers between two instructions of the main thread, and an executor waits inside
the middleware. So the signal's number goes through Python's wake-up descriptor to a thread that
wakes everybody who waits.
"""

from enum import IntEnum
import os
import signal
import threading
from types import FrameType
from typing import Any
import weakref

from rclpy.context import Context


class SignalHandlerOptions(IntEnum):
    """Which signals are handled."""

    NO = 0
    SIGINT = 1
    SIGTERM = 2
    ALL = 3


_contexts: 'weakref.WeakSet[Context]' = weakref.WeakSet()
_previous: dict[int, Any] = {}
_descriptors: tuple[int, int, int] | None = None  # read, write, who had it before


def watch(context: Context) -> None:
    """Shut this context down when a signal comes."""
    _contexts.add(context)


def _interrupt() -> None:
    for context in list(_contexts):
        context._interrupt()


def _handle(number: int, frame: FrameType | None) -> None:
    _interrupt()
    previous = _previous.get(number)
    if callable(previous):
        previous(number, frame)


def _listen(read: int, forward: int) -> None:
    while True:
        data = os.read(read, 64)
        if not data:
            os.close(read)
            return
        if any(number in _previous for number in data):
            _interrupt()
        if forward >= 0:
            os.write(forward, data)


def install_signal_handlers(options: SignalHandlerOptions = SignalHandlerOptions.ALL) -> None:
    """Handle signals from now on; only possible in the main thread, elsewhere nothing happens."""
    global _descriptors
    if threading.current_thread() is not threading.main_thread():
        return
    uninstall_signal_handlers()
    wanted = [number for option, number in ((SignalHandlerOptions.SIGINT, signal.SIGINT),
                                            (SignalHandlerOptions.SIGTERM, signal.SIGTERM))
              if options & option]
    if not wanted:
        return
    read, write = os.pipe()
    os.set_blocking(write, False)
    before = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    _descriptors = (read, write, before)
    threading.Thread(target=_listen, args=(read, before), name='rclpy signals',
                     daemon=True).start()
    for number in wanted:
        _previous[number] = signal.signal(number, _handle)


def uninstall_signal_handlers() -> None:
    """Put back what handled the signals before."""
    global _descriptors
    if threading.current_thread() is not threading.main_thread() or _descriptors is None:
        return
    for number, previous in _previous.items():
        if signal.getsignal(number) is _handle:
            signal.signal(number, previous if previous is not None else signal.SIG_DFL)
    _previous.clear()
    _, write, before = _descriptors
    current = signal.set_wakeup_fd(before)
    if current != write:  # somebody else took it over meanwhile
        signal.set_wakeup_fd(current)
    os.close(write)  # ends the thread
    _descriptors = None
