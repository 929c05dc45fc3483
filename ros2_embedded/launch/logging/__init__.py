# SPDX-License-Identifier: Apache-2.0
"""
Loggers that write to the screen and to a log directory of this launch.

Importing this makes all loggers created later handle their own records only.
"""
from __future__ import annotations

import datetime
import logging
import os
import sys
from typing import Any, Dict, List, Mapping, Optional, Set, Tuple
import warnings

from . import handlers

__all__ = ['get_logger', 'get_output_loggers', 'handlers', 'launch_config', 'reset']

_SCREEN_FORMATS = {
    'default': '[{levelname}] [{name}]: {msg}',
    'default_with_timestamp': '{created:.7f} [{levelname}] [{name}]: {msg}',
}
_LOG_FORMATS = {'default': _SCREEN_FORMATS['default_with_timestamp']}
_OUTPUTS: Dict[str, Dict[str, Set[str]]] = {
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
    while True:
        stamp = datetime.datetime.now().strftime('%Y-%m-%d-%H-%M-%S-%f')
        directory = os.path.join(base, f'{stamp}-{os.uname().nodename}-{os.getpid()}')
        try:
            os.makedirs(directory)
        except FileExistsError:
            continue
        latest = os.path.join(base, 'latest')
        try:
            if os.path.islink(latest):
                os.unlink(latest)
            os.symlink(directory, latest, target_is_directory=True)
        except OSError as exc:
            warnings.warn(
                f'Cannot create a symlink to latest log directory: {exc}', stacklevel=2)
        return directory


def _make_formatter(
    text: Optional[str], style: Optional[str], named: Mapping[str, str], kind: str
) -> Optional[logging.Formatter]:
    override = os.environ.get(f'OVERRIDE_LAUNCH_{kind.upper()}_FORMAT')
    if override:
        text, style = override.encode('latin1').decode('unicode_escape'), '{'
    elif text in named and text is not None:
        if style is not None:
            raise ValueError(
                f'Cannot set a custom format style for the "{text}" {kind} format.')
        text = named[text]
    if text is None:
        return None
    return logging.Formatter(text, style=style or '{')  # type: ignore[arg-type]


class LaunchConfig:
    """Where launch logs to, how, and from which level on."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget directory, handlers and formats."""
        self._log_dir: Optional[str] = None
        self.file_handlers: Dict[str, Any] = {}
        self.screen_handler: Any = None
        self.log_handler_factory: Any = handlers.WatchedFileHandler
        logging.root.setLevel(logging.INFO)
        self.set_screen_format('default')
        self.set_log_format('default')

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
    def log_dir(self, new_log_dir: Optional[str]) -> None:
        if new_log_dir is not None:
            if self.file_handlers:
                warnings.warn(
                    'Loggers have been already configured to output to log files below '
                    f'{self._log_dir}. Proceed at your own risk.', stacklevel=2)
            if not os.path.isdir(new_log_dir):
                raise ValueError(f'{new_log_dir} is not a directory')
        self._log_dir = new_log_dir

    def set_screen_format(
        self, screen_format: Optional[str], *, screen_style: Optional[str] = None
    ) -> None:
        """Set the screen's format: 'default', 'default_with_timestamp' or a text."""
        self.screen_formatter = _make_formatter(
            screen_format, screen_style, _SCREEN_FORMATS, 'screen')
        if self.screen_handler is not None and self.screen_formatter is not None:
            self.screen_handler.setFormatter(self.screen_formatter)

    def get_screen_handler(self) -> Any:
        if self.screen_handler is None:
            self.screen_handler = handlers.StreamHandler(_Screen())
            self.screen_handler.setFormatter(self.screen_formatter)
        return self.screen_handler

    def set_log_format(
        self, log_format: Optional[str], *, log_style: Optional[str] = None
    ) -> None:
        """Set the log files' format: 'default' or a text."""
        self.file_formatter = _make_formatter(log_format, log_style, _LOG_FORMATS, 'log')
        if self.file_formatter is not None:
            for handler in self.file_handlers.values():
                handler.setFormatter(self.file_formatter)

    def get_log_file_path(self, file_name: str = 'launch.log') -> str:
        return os.path.join(self.log_dir, file_name)

    def get_log_file_handler(self, file_name: str = 'launch.log') -> Any:
        if file_name not in self.file_handlers:
            handler = self.log_handler_factory(
                self.get_log_file_path(file_name), encoding='utf-8')
            handler.setFormatter(self.file_formatter)
            self.file_handlers[file_name] = handler
        return self.file_handlers[file_name]


class _Screen:
    """Standard output, with replacements for what its encoding lacks."""

    def __init__(self) -> None:
        self.__stream = sys.stdout

    def write(self, text: str) -> None:
        encoding = getattr(self.__stream, 'encoding', None) or 'utf-8'
        self.__stream.write(text.encode(encoding, 'replace').decode(encoding))

    def flush(self) -> None:
        self.__stream.flush()


launch_config = LaunchConfig()


def log_launch_config(*, logger: logging.Logger = logging.root) -> None:
    if launch_config.file_handlers:
        logger.info(f'All log files can be found below {launch_config.log_dir}')
    level = logging.getLevelName(logging.root.getEffectiveLevel())
    logger.info(f'Default logging verbosity is set to {level}')


def get_logger(name: Optional[str] = None) -> logging.Logger:
    """Return the logger of that name, with the screen's and the main log file's handlers."""
    logger = logging.getLogger(name)
    _add(logger, launch_config.get_screen_handler())
    _add(logger, launch_config.get_log_file_handler())
    return logger


def _add(logger: logging.Logger, handler: Any, own_format: Optional[str] = None) -> None:
    if handler not in logger.handlers:
        logger.addHandler(handler)
        if own_format is not None:
            handler.setFormatterFor(logger, logging.Formatter(own_format, style='{'))


def _normalize_output_configuration(config: Any) -> Dict[str, Set[str]]:
    normalized: Dict[str, Set[str]] = {'both': set(), 'stdout': set(), 'stderr': set()}
    if isinstance(config, str):
        if config not in _OUTPUTS:
            raise ValueError(
                f'{config} is not a valid standard output config i.e. "screen", "log" or "both"')
        return {**normalized, **_OUTPUTS[config]}
    if not isinstance(config, dict):
        raise ValueError(f'{config} is not a valid output configuration')
    for source, destinations in config.items():
        if source not in normalized:
            raise ValueError(
                f'{source} is not a valid output source i.e. "stdout", "stderr" or "both"')
        normalized[source] = {destinations} if isinstance(destinations, str) else set(destinations)
        for destination in normalized[source] - {'screen', 'log', 'own_log'}:
            raise ValueError(
                f'{destination} is not a valid output destination '
                'i.e. "screen", "log" or "own_log"')
    return normalized


def get_output_loggers(
    process_name: str, output_config: Any
) -> Tuple[logging.Logger, logging.Logger]:
    """
    Return the loggers for a process's standard output and standard error.

    :param output_config: 'screen', 'log', 'both', 'own_log', 'full', or a dictionary from
        'stdout', 'stderr', 'both' to one or more of 'screen', 'log', 'own_log'.
    :raises ValueError: for anything else.
    """
    config = _normalize_output_configuration(output_config)
    loggers: List[logging.Logger] = []
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

    all_loggers: List[logging.Logger] = []

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.propagate = False
        LaunchLogger.all_loggers.append(self)


def reset() -> None:
    """Take handlers and levels from all loggers made so far, and forget the configuration."""
    for logger in LaunchLogger.all_loggers:
        logger.setLevel(logging.NOTSET)
        logger.handlers.clear()
    launch_config.reset()
    logging.setLoggerClass(LaunchLogger)


reset()
