# SPDX-License-Identifier: Apache-2.0
"""
Shut rclpy down on SIGINT and SIGTERM, in a thread.

``rclpy.spin`` then returns, or raises ExternalShutdownException, between two callbacks. Python's
own handler raises KeyboardInterrupt anywhere, such as in ``Condition.__enter__``, which leaves the
lock acquired. rclpy's handler wakes the executor before it shuts the context down, so that a node
without timers may wait again, until it is killed.
"""

from __future__ import annotations

import os
import signal
import threading

import rclpy
from rclpy.signals import SignalHandlerOptions

_SIGNALS = signal.SIGINT, signal.SIGTERM


def init() -> None:
    """Initialize rclpy, in place of ``rclpy.init``; call this in the main thread."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer)
    for number in _SIGNALS:
        signal.signal(number, _ignore_further)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    threading.Thread(target=_shut_down, args=(reader,), name='ending', daemon=True).start()


def _ignore_further(*_: object) -> None:
    # SIG_IGN stays to the end of the process. Python replaces its handlers by the default ones
    # before that, and a second signal would kill the process.
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _shut_down(reader: int) -> None:
    os.read(reader, 1)
    rclpy.try_shutdown()
