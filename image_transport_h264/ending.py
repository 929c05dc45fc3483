# SPDX-License-Identifier: Apache-2.0
"""
Run a node, and shut rclpy down on SIGINT and SIGTERM, in a thread.

The executor then returns, or raises ExternalShutdownException, between two callbacks. Python's
own handler raises KeyboardInterrupt anywhere, such as in ``Condition.__enter__``, which leaves the
lock acquired. rclpy's handler wakes the executor before it shuts the context down, so that a node
without timers may wait again, until it is killed.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import ctypes
import functools
import os
import signal
import threading
import time
from typing import Optional, TypeVar

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from image_transport_h264 import memory

Made = TypeVar('Made', bound=Node)
_SIGNALS = signal.SIGINT, signal.SIGTERM
#: Seconds that a signal waits for a node that is being made.
LONGEST = 5.0
#: Seconds for the end of the middleware's part of a node.
TOO_LONG = 4.0


class _Event(ctypes.Structure):
    """POSIX's ``sigevent``, which calls a function of C in a new thread."""

    _fields_ = [('value', ctypes.c_void_p), ('number', ctypes.c_int), ('notify', ctypes.c_int),
                ('function', ctypes.c_void_p), ('rest', ctypes.c_byte * 40)]


def run(
    make: Callable[[], Made], refuse: Optional[Callable[[Made, str], None]] = None,
) -> Optional[Made]:
    """
    Run a node until a signal, and destroy it; call this in the main thread.

    :param make: creates the node, perhaps in an executor.
    :param refuse: handles a RuntimeError of a callback, after which the node goes on.
    :return: the node, None if the signal came first.
    """
    memory.keep()
    made = _init()
    node: Optional[Made] = None
    try:
        node = make()
        executor = node.executor or SingleThreadedExecutor()
        executor.add_node(node)
        made.set()
        while rclpy.ok():
            try:
                executor.spin()
            except RuntimeError as error:
                if refuse is None or not rclpy.ok():
                    raise
                refuse(node, str(error))
    except Exception:
        # a signal while the node publishes is an error of rclpy
        if rclpy.ok():
            raise
    finally:
        if node is not None:
            with node.handle:  # the middleware's part ends with this block
                node.destroy_node()
                _exit_after(TOO_LONG)
            _exit_after(0.0)
    return node


@functools.cache
def _timer() -> Callable[[float], object]:
    """Return what sets the seconds until this process exits with status 0."""
    library, timer = ctypes.CDLL(None), ctypes.c_void_p()
    event = _Event(0, 0, 2, ctypes.cast(library._exit, ctypes.c_void_p))  # SIGEV_THREAD
    library.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer))

    def set_to(seconds: float) -> object:
        times = (ctypes.c_long * 4)(0, 0, int(seconds), int(seconds % 1 * 1e9))
        return library.timer_settime(timer, 0, times, None)

    return set_to


def _exit_after(seconds: float) -> None:
    """
    Exit with status 0 after a time, 0 for never, without Python.

    A node of ROS 2's wheels may hang while it is destroyed, and holds Python's lock meanwhile: if
    another participant ends at that moment, Fast DDS waits for a callback without a limit. Built
    for an older C library, this wait gets an invalid time and keeps the lock of the callback.
    """
    with contextlib.suppress(AttributeError):  # glibc before 2.34 has no timers in its main part
        _timer()(seconds)


def _init() -> threading.Event:
    """Initialize rclpy; return what to set when the node is complete."""
    made = threading.Event()
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer)
    for number in _SIGNALS:
        signal.signal(number, _ignore_further)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    threading.Thread(target=_shut_down, args=(reader, made), name='ending', daemon=True).start()
    return made


def _ignore_further(*_: object) -> None:
    # SIG_IGN stays to the end of the process. Python replaces its handlers by the default ones
    # before that, and a second signal would kill the process.
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _shut_down(reader: int, made: threading.Event) -> None:
    os.read(reader, 1)
    made.wait(LONGEST)  # an executor that is half made prints an error
    rclpy.try_shutdown()
