# SPDX-License-Identifier: Apache-2.0
"""
Keep launch's log files within a limit, and a launch alive whose log files cannot be written.

A machine may print without end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import functools
import logging
import os
from pathlib import Path
import sys

import launch.logging

from fogros2.errors import ConfigurationError

#: Maximum bytes of a log file, of which one earlier part stays; bytes between two looks.
LIMIT, LOOK = 64 << 20, 1 << 20


class LogFiles:
    """The log files of this launch; launch opens a file again that has been renamed."""

    def __init__(self) -> None:
        self._size = 0

    def add(self, size: int) -> None:
        """Note that so many bytes may have been written; rename files that are too large."""
        self._size += size
        if self._size < LOOK:
            return
        self._size = 0
        with contextlib.suppress(OSError):
            for path in Path(launch.logging.launch_config.log_dir).glob('*.log'):
                if path.stat().st_size > LIMIT:
                    path.replace(f'{path}.1')


def prepare() -> None:
    """
    Make the log folder of this launch; from now on, report a full disk once.

    :raises ConfigurationError: the folder cannot be made.
    """
    try:
        handler = launch.logging.launch_config.get_log_file_handler()
    except OSError as error:
        raise ConfigurationError(
            f"launch's log folder can't be made: {error.filename}: {error.strerror}",
            'ROS_LOG_DIR names another folder for it') from error
    handler.handleError = functools.partial(_report, handler, handler.handleError)


@contextlib.contextmanager
def none() -> Iterator[None]:
    """Let launch make no log files in this block, which reads a launch file and runs nothing."""
    config = launch.logging.launch_config
    before = config.log_handler_factory
    config.log_dir, config.log_handler_factory = os.sep, lambda *_, **__: logging.NullHandler()
    try:
        yield
    finally:
        config.log_dir, config.log_handler_factory = None, before
        config.file_handlers.clear()


def _report(
    handler: logging.Handler, otherwise: Callable[[logging.LogRecord], None],
    record: logging.LogRecord,
) -> None:
    """Report an OSError once, which logging would report by a traceback for each line."""
    error = sys.exc_info()[1]
    if not isinstance(error, OSError):
        otherwise(record)
        return
    handler.handleError = lambda record: None  # type: ignore[method-assign]
    launch.logging.get_logger('fogros2').warning(
        f"launch's log file can't be written: {error.strerror}\nthe launch goes on without it")
