# SPDX-License-Identifier: Apache-2.0
"""SIGTERM and SIGHUP as the launch's own, orderly shutdown."""

from __future__ import annotations

from collections.abc import Callable
import signal
import threading
from types import FrameType
from typing import Any, Optional

from launch import LaunchContext
from launch.events import Shutdown
import launch.logging

from fogros2.actions import private


def _noticed(number: int, frame: Optional[FrameType]) -> None:
    """Let Python notice a signal; launch's signal manager then hears of it on its loop."""


def take_over(context: LaunchContext) -> Callable[[], None]:
    """
    Make SIGTERM and SIGHUP shut the launch down in order; return what undoes that.

    Left alone, both kill ``ros2 launch`` on the spot and leave its machines behind. A signal that
    was ignored from the start (``nohup``) stays ignored. SIGINT stays launch's, but no longer
    raises KeyboardInterrupt wherever the main thread is, which could cut a rollback short.
    """
    manager = private.signal_manager()
    if manager is None or threading.current_thread() is not threading.main_thread():
        return lambda: None
    logger = launch.logging.get_logger('fogros2')
    asked = False

    def shut_down(number: int) -> None:
        nonlocal asked
        name = signal.Signals(number).name
        if asked or context.is_shutdown:
            logger.warning(f'{name}: shutting down already')
            return
        asked = True
        logger.warning(f'{name}: shutting down')
        context.emit_event_sync(Shutdown(reason=name, due_to_sigint=False))

    before: dict[int, Any] = {}
    handlers: dict[int, Any] = {}
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        if signal.getsignal(number) == signal.SIG_IGN:
            continue
        before[number] = signal.signal(number, _noticed)
        if number != signal.SIGINT:
            handlers[number] = manager.handle(number, shut_down)

    def undo() -> None:
        for number, handler in handlers.items():
            manager.handle(number, handler)
        for number, handler in before.items():
            signal.signal(number, handler)

    return undo
