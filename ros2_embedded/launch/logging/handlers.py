# SPDX-License-Identifier: Apache-2.0
"""The handlers of :mod:`logging`, each able to format some loggers' records differently."""
import logging
import logging.handlers
from typing import Any, Dict, Type, Union

_classes: Dict[Type[logging.Handler], Any] = {}


class _PerLoggerFormatting:
    """What each handler here has beside its original."""

    _formatters: Dict[str, logging.Formatter]

    def setFormatterFor(
        self, logger: Union[str, logging.Logger], formatter: logging.Formatter
    ) -> None:
        """Format records of this logger, and of no other, with this formatter."""
        self.__dict__.setdefault('_formatters', {})[_name(logger)] = formatter

    def unsetFormatterFor(self, logger: Union[str, logging.Logger]) -> None:
        """Format records of this logger like all others."""
        self.__dict__.setdefault('_formatters', {}).pop(_name(logger), None)

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's text, by its logger's own formatter if there is one."""
        own = self.__dict__.get('_formatters', {}).get(record.name)
        if own is not None:
            return str(own.format(record))
        return str(super().format(record))  # type: ignore[misc]


def _name(logger: Union[str, logging.Logger]) -> str:
    return logger if isinstance(logger, str) else logger.name


def with_per_logger_formatting(cls: Type[logging.Handler]) -> Any:
    """Return the handler class with ``setFormatterFor`` and ``unsetFormatterFor``."""
    if cls not in _classes:
        _classes[cls] = type(
            cls.__name__, (_PerLoggerFormatting, cls), {'__doc__': cls.__doc__})
    return _classes[cls]


def __getattr__(name: str) -> Any:
    handler = getattr(logging, name, getattr(logging.handlers, name, None))
    if not (isinstance(handler, type) and issubclass(handler, logging.Handler)):
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return with_per_logger_formatting(handler)
