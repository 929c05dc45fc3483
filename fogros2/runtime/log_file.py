# SPDX-License-Identifier: Apache-2.0
"""Handle a log folder of launch that cannot be made or written."""

from __future__ import annotations

from collections.abc import Callable
import functools
import logging
import sys

import launch.logging

from fogros2.errors import ConfigurationError


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
