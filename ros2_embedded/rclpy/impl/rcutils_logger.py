# SPDX-License-Identifier: Apache-2.0
"""Loggers, with the filters once, skip_first and throttle for each place they are called from."""

import sys
from typing import Any

from rclpy.impl.logging_severity import LoggingSeverity

_OPTIONS = ('throttle_duration_sec', 'throttle_time_source_type', 'skip_first', 'once')


class _Place:
    """What a filter remembers of one place in a program."""

    def __init__(self, name: str, severity: LoggingSeverity, options: dict[str, Any]) -> None:
        self.name, self.severity, self.options = name, severity, options
        self.calls = 0
        self.logged_at = 0.0
        self.clock = None
        if options.get('throttle_duration_sec'):
            from rclpy.clock import Clock
            self.clock = options.get('throttle_time_source_type') or Clock()
            if not isinstance(self.clock, Clock):
                raise ValueError(f'Received throttle_time_source_type of "{self.clock}" '
                                 'is not a clock instance')

    def passes(self) -> bool:
        if self.clock is not None:
            now = self.clock.now().nanoseconds
            if now < self.logged_at + self.options['throttle_duration_sec'] * 1e9:
                return False
            self.logged_at = now
        self.calls += 1
        skipped = bool(self.options.get('skip_first'))
        if skipped and self.calls == 1:
            return False
        return not self.options.get('once') or self.calls == 1 + skipped


class RcutilsLogger:
    """A logger; dots in its name say which logger it is below."""

    def __init__(self, name: str = '') -> None:
        self.name = name
        self._places: dict[tuple[Any, int], _Place] = {}

    def get_child(self, name: str) -> 'RcutilsLogger':
        """
        Give the logger of this name below this one.

        :raises ValueError: if the name is empty.
        """
        if not name:
            raise ValueError('Child logger name must not be empty.')
        return RcutilsLogger(f'{self.name}.{name}' if self.name else name)

    def set_level(self, level: int | LoggingSeverity) -> None:
        """Set its level."""
        from rclpy import logging
        logging.set_logger_level(self.name, level)

    def get_effective_level(self) -> LoggingSeverity:
        """Give the level in force."""
        from rclpy import logging
        return logging.get_logger_effective_level(self.name)

    def is_enabled_for(self, severity: int | LoggingSeverity) -> bool:
        """Say whether messages of a severity are logged."""
        return LoggingSeverity(severity) >= self.get_effective_level()

    def log(self, message: Any, severity: int | LoggingSeverity, **kwargs: Any) -> bool:
        """
        Log a message.

        :param throttle_duration_sec: not more often than this, by ``throttle_time_source_type``,
            a clock.
        :param skip_first: not the first time this place is reached.
        :param once: only once from this place.
        :returns: whether it was logged.
        :raises TypeError: for an unknown option, or one without those it needs.
        :raises ValueError: if options change between calls from one place.
        """
        from rclpy import logging
        severity = LoggingSeverity(severity)
        if severity < logging.get_logger_effective_level(self.name):
            return False
        name = kwargs.pop('name', self.name)
        for option in kwargs:
            if option not in _OPTIONS:
                raise TypeError(f'parameter "{option}" is not one of the recognized logging '
                                f'options "{list(_OPTIONS)}"')
        if kwargs.get('throttle_time_source_type') and not kwargs.get('throttle_duration_sec'):
            raise TypeError('required parameter "throttle_duration_sec" not specified but is '
                            'required for the the logging filter "throttle"')
        frame: Any = sys._getframe(1)
        while frame.f_back is not None and frame.f_code.co_filename == __file__:
            frame = frame.f_back
        key = (frame.f_code, frame.f_lasti)
        place = self._places.get(key)
        if place is None:
            place = self._places[key] = _Place(name, severity, kwargs)
        elif severity != place.severity:
            raise ValueError('Logger severity cannot be changed between calls.')
        elif name != place.name:
            raise ValueError('Logger name cannot be changed between calls.')
        elif kwargs != place.options:
            raise ValueError('Logging filter parameters cannot be changed between calls.')
        if not place.passes():
            return False
        logging._write(severity, name, str(message), frame.f_code.co_name,
                       frame.f_code.co_filename, frame.f_lineno)
        return True

    def debug(self, message: Any, **kwargs: Any) -> bool:
        """Log with severity DEBUG."""
        return self.log(message, LoggingSeverity.DEBUG, **kwargs)

    def info(self, message: Any, **kwargs: Any) -> bool:
        """Log with severity INFO."""
        return self.log(message, LoggingSeverity.INFO, **kwargs)

    def warning(self, message: Any, **kwargs: Any) -> bool:
        """Log with severity WARN."""
        return self.log(message, LoggingSeverity.WARN, **kwargs)

    warn = warning  # its older name

    def error(self, message: Any, **kwargs: Any) -> bool:
        """Log with severity ERROR."""
        return self.log(message, LoggingSeverity.ERROR, **kwargs)

    def fatal(self, message: Any, **kwargs: Any) -> bool:
        """Log with severity FATAL."""
        return self.log(message, LoggingSeverity.FATAL, **kwargs)
