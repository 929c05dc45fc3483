# SPDX-License-Identifier: Apache-2.0
"""Handle SIGTERM and SIGHUP as an orderly shutdown of the launch."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import signal
import threading
from types import FrameType
from typing import Optional

from launch import LaunchContext
from launch.events import Shutdown
import launch.logging

from fogros2.launch_internals import private


def _noticed(number: int, frame: Optional[FrameType]) -> None:
    """Do nothing: a Python handler makes launch's signal manager see the signal."""


def take_over(context: LaunchContext) -> Callable[[], None]:
    """
    Make SIGTERM and SIGHUP shut the launch down in order; return the undo function.

    By default both kill ``ros2 launch`` at once and leave its machines behind. A signal that was
    ignored from the start stays ignored: SIGHUP under ``nohup``, SIGINT in the background of a
    script. launch still handles SIGINT, but SIGINT no longer raises KeyboardInterrupt in the main
    thread, which could interrupt a rollback.
    """
    manager = private.signal_manager()
    if manager is None or threading.current_thread() is not threading.main_thread():
        return lambda: None
    logger = launch.logging.get_logger('fogros2')
    requested = False

    def shut_down(number: int) -> None:
        nonlocal requested
        name = signal.Signals(number).name
        if requested or context.is_shutdown:
            logger.warning(f'{name}: shutting down already')
            return
        requested = True
        logger.warning(f'{name}: shutting down')
        context.emit_event_sync(Shutdown(reason=name, due_to_sigint=False))

    undo = contextlib.ExitStack()
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        if signal.getsignal(number) == signal.SIG_IGN:
            continue
        undo.callback(signal.signal, number, signal.signal(number, _noticed))
        if number != signal.SIGINT:
            undo.callback(manager.handle, number, manager.handle(number, shut_down))
    return undo.close
