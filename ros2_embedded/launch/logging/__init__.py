# SPDX-License-Identifier: Apache-2.0
"""
Loggers that write to the screen and to a log directory of this launch.

Importing this makes all loggers created later handle their own records only.
"""
from __future__ import annotations

import contextlib
import datetime
import logging
import logging.handlers
import os
import sys
from typing import Any

__all__ = ['get_logger', 'get_output_loggers', 'launch_config', 'reset']

_FORMATS = {
    'SCREEN': '[{levelname}] [{name}]: {msg}',
    'LOG': '{created:.7f} [{levelname}] [{name}]: {msg}',
}
_OUTPUTS = {
    'screen': {'both': {'screen'}},
    'log': {'both': {'log'}, 'stderr': {'screen'}},
    'both': {'both': {'log', 'screen'}},
    'own_log': {'both': {'own_log'}, 'stdout': {'own_log'}, 'stderr': {'own_log'}},
    'full': {'both': {'screen', 'log', 'own_log'}, 'stdout': {'own_log'}, 'stderr': {'own_log'}},
}


def _get_logging_directory() -> str:
    home = os.environ.get('ROS_HOME') or os.path.join('~', '.ros')
    directory = os.environ.get('ROS_LOG_DIR') or os.path.join(home, 'log')
    return os.path.normpath(os.path.expanduser(directory))


def _make_log_dir(base: str) -> str:
    stamp = datetime.datetime.now().strftime('%Y-%m-%d-%H-%M-%S-%f')
    directory = os.path.join(base, f'{stamp}-{os.uname().nodename}-{os.getpid()}')
    os.makedirs(directory)
    latest = os.path.join(base, 'latest')
    with contextlib.suppress(OSError):  # another launch may do the same
        if os.path.islink(latest):
            os.unlink(latest)
        os.symlink(directory, latest, target_is_directory=True)
    return directory


class _Formatter(logging.Formatter):
    """
    Formats records for 'SCREEN' or 'LOG' as the environment wants it, and some loggers' otherwise.

    :param own: the formatters of these loggers, by their names.
    """

    def __init__(self, kind: str) -> None:
        override = os.environ.get(f'OVERRIDE_LAUNCH_{kind}_FORMAT', '')
        super().__init__(
            override.encode('latin1').decode('unicode_escape') or _FORMATS[kind], style='{')
        self.own: dict[str, logging.Formatter] = {}

    def format(self, record: logging.LogRecord) -> str:
        own = self.own.get(record.name)
        return super().format(record) if own is None else own.format(record)


class LaunchConfig:
    """Where launch logs to, and from which level on."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget directory and handlers."""
        self._log_dir: str | None = None
        self.file_handlers: dict[str, Any] = {}
        self.screen_handler: Any = None
        self.log_handler_factory: Any = logging.handlers.WatchedFileHandler
        self.level = logging.INFO

    @property
    def level(self) -> int:
        return logging.root.getEffectiveLevel()

    @level.setter
    def level(self, new_level: Any) -> None:
        logging.root.setLevel(new_level)

    @property
    def log_dir(self) -> str:
        """The directory of this launch's log files, made when first asked for."""
        if self._log_dir is None:
            self._log_dir = _make_log_dir(_get_logging_directory())
        return self._log_dir

    @log_dir.setter
    def log_dir(self, new_log_dir: str | None) -> None:
        if new_log_dir is not None and not os.path.isdir(new_log_dir):
            raise ValueError(f'{new_log_dir} is not a directory')
        self._log_dir = new_log_dir

    def get_screen_handler(self) -> Any:
        if self.screen_handler is None:
            self.screen_handler = logging.StreamHandler(sys.stdout)
            self.screen_handler.setFormatter(_Formatter('SCREEN'))
        return self.screen_handler

    def get_log_file_handler(self, file_name: str = 'launch.log') -> Any:
        if file_name not in self.file_handlers:
            handler = self.log_handler_factory(
                os.path.join(self.log_dir, file_name), encoding='utf-8')
            handler.setFormatter(_Formatter('LOG'))
            self.file_handlers[file_name] = handler
        return self.file_handlers[file_name]


launch_config = LaunchConfig()


def log_launch_config(*, logger: logging.Logger = logging.root) -> None:
    if launch_config.file_handlers:
        logger.info(f'All log files can be found below {launch_config.log_dir}')
    level = logging.getLevelName(logging.root.getEffectiveLevel())
    logger.info(f'Default logging verbosity is set to {level}')


def get_logger(name: str | None = None) -> logging.Logger:
    """Return the logger of that name, with the screen's and the main log file's handlers."""
    logger = logging.getLogger(name)
    _add(logger, launch_config.get_screen_handler())
    _add(logger, launch_config.get_log_file_handler())
    return logger


def _add(logger: logging.Logger, handler: Any, own_format: str | None = None) -> None:
    if handler not in logger.handlers:
        logger.addHandler(handler)
        if own_format is not None:
            handler.formatter.own[logger.name] = logging.Formatter(own_format, style='{')


def _normalize_output_configuration(config: Any) -> dict[str, set[str]]:
    normalized: dict[str, set[str]] = {'both': set(), 'stdout': set(), 'stderr': set()}
    if isinstance(config, str):
        if config not in _OUTPUTS:
            raise ValueError(
                f'{config} is not a valid standard output config i.e. "screen", "log" or "both"')
        return {**normalized, **_OUTPUTS[config]}
    if not isinstance(config, dict):
        raise ValueError(f'{config} is not a valid output configuration')
    for source, destinations in config.items():
        wanted = {destinations} if isinstance(destinations, str) else set(destinations)
        if source not in normalized or not wanted <= {'screen', 'log', 'own_log'}:
            raise ValueError(
                f'{source}: {destinations} is not a valid output source i.e. "stdout", "stderr" '
                'or "both", with a valid output destination i.e. "screen", "log" or "own_log"')
        normalized[source] = wanted
    return normalized


def get_output_loggers(
    process_name: str, output_config: Any
) -> tuple[logging.Logger, logging.Logger]:
    """
    Return the loggers for a process's standard output and standard error.

    :param output_config: 'screen', 'log', 'both', 'own_log', 'full', or a dictionary from
        'stdout', 'stderr', 'both' to one or more of 'screen', 'log', 'own_log'.
    :raises ValueError: for anything else.
    """
    config = _normalize_output_configuration(output_config)
    loggers: list[logging.Logger] = []
    for source in ('stdout', 'stderr'):
        logger = logging.getLogger(f'{process_name}-{source}')
        loggers.append(logger)
        wanted = config['both'] | config[source]
        if 'screen' in wanted:
            _add(logger, launch_config.get_screen_handler(), '{msg}')
        if 'log' in wanted:
            _add(logger, launch_config.get_log_file_handler(), '{created:.7f} {msg}')
        for kind, name in ((source, f'{process_name}-{source}.log'),
                           ('both', f'{process_name}.log')):
            if 'own_log' in config[kind]:
                _add(logger, launch_config.get_log_file_handler(name), '{msg}')
    return loggers[0], loggers[1]


class LaunchLogger(logging.getLoggerClass()):  # type: ignore[misc]
    """A logger that handles its own records only."""

    all_loggers: list[logging.Logger] = []

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.propagate = False
        LaunchLogger.all_loggers.append(self)


def reset() -> None:
    """Take handlers and levels from all loggers made so far, and forget the configuration."""
    for logger in LaunchLogger.all_loggers:
        if logger.level:  # setLevel() clears the caches of all loggers, which takes long
            logger.setLevel(logging.NOTSET)
        logger.handlers.clear()
    launch_config.reset()
    logging.setLoggerClass(LaunchLogger)


reset()
