# SPDX-License-Identifier: Apache-2.0
"""Logging: to the console in ROS's format, and to /rosout."""

from collections.abc import Callable
import os
import re
import sys
import threading
import time
from typing import Any, TextIO, TYPE_CHECKING

from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.impl.rcutils_logger import RcutilsLogger
from rosidl_embedded.lacking import lacking

if TYPE_CHECKING:
    from rclpy._arguments import Arguments

__all__ = ['LoggingSeverity', 'RcutilsLogger', 'get_logger', 'get_logger_effective_level',
           'get_logger_level', 'set_logger_level']
__getattr__ = lacking(__name__, 'clear_config get_logging_directory '
                                'get_logging_severity_from_string initialize shutdown')

_COLOURS = {LoggingSeverity.DEBUG: '\033[32m', LoggingSeverity.INFO: '\033[0m',
            LoggingSeverity.WARN: '\033[33m', LoggingSeverity.ERROR: '\033[31m',
            LoggingSeverity.FATAL: '\033[31m'}
_FORMAT = '[{severity}] [{time}] [{name}]: {message}'

_levels: dict[str, int] = {}
_default_level = LoggingSeverity.INFO
_console = True
_lock = threading.Lock()
# a logger's name -> what publishes its messages on /rosout
_rosout: dict[str, Callable[..., None]] = {}


def get_logger(name: str) -> RcutilsLogger:
    """
    Give the logger of a name.

    :raises ValueError: if the name is empty.
    """
    if not name:
        raise ValueError('Logger name must not be empty.')
    return RcutilsLogger(name)


def _configure(arguments: 'Arguments') -> None:
    """Take over what the command line says."""
    global _console
    for name, level in arguments.levels:
        set_logger_level(name, level)
    _console = arguments.switches.get('stdout', True)


def set_logger_level(name: str, level: int | LoggingSeverity,
                     detailed_error: bool = False) -> None:
    """Set the level of a logger and of those below it."""
    global _default_level
    severity = LoggingSeverity(level)
    if name:
        _levels[name] = severity
    else:
        _default_level = severity


def get_logger_level(name: str) -> LoggingSeverity:
    """Give the level that was set for a logger, or UNSET."""
    return LoggingSeverity(_levels.get(name, LoggingSeverity.UNSET) if name else _default_level)


def get_logger_effective_level(name: str) -> LoggingSeverity:
    """Give the level in force: its own, or that of the nearest logger above it."""
    while name:
        if level := _levels.get(name):
            return LoggingSeverity(level)
        name = name.rpartition('.')[0]
    return _default_level


def _coloured(stream: TextIO) -> bool:
    wanted = os.environ.get('RCUTILS_COLORIZED_OUTPUT', '')
    return stream.isatty() if wanted not in ('0', '1') else wanted == '1'


def _write(severity: LoggingSeverity, name: str, message: str, function: str, file: str,
           line: int) -> None:
    """Log a message that has passed all filters."""
    stamp = time.time_ns()
    if _console:
        values: dict[str, Any] = {
            'severity': severity.name, 'name': name, 'message': message, 'function_name': function,
            'file_name': file, 'line_number': line, 'time_as_nanoseconds': f'{stamp:019d}',
            'time': f'{stamp // 10 ** 9}.{stamp % 10 ** 9:09d}'}
        layout = os.environ.get('RCUTILS_CONSOLE_OUTPUT_FORMAT') or _FORMAT
        text = re.sub(r'\{(\w+)\}', lambda found: str(values.get(found[1], found[0])), layout)
        stream = sys.stdout if os.environ.get('RCUTILS_LOGGING_USE_STDOUT') == '1' else sys.stderr
        if _coloured(stream):
            text = f'{_COLOURS[severity]}{text}\033[0m'
        with _lock:
            stream.write(text + '\n')
            stream.flush()
    above = name
    while above:
        if publish := _rosout.get(above):
            publish(stamp, severity, name, message, file, function, line)
            return
        above = above.rpartition('.')[0]
