# SPDX-License-Identifier: Apache-2.0
"""The handlers of :mod:`logging`, each able to format some loggers' records differently."""
import logging
import logging.handlers
from typing import Any


class _PerLoggerFormatting:

    def setFormatterFor(self, logger: Any, formatter: logging.Formatter) -> None:
        """Format records of this logger, and of no other, with this formatter."""
        self.__dict__.setdefault('_formatters', {})[getattr(logger, 'name', logger)] = formatter

    def format(self, record: logging.LogRecord) -> str:
        own = self.__dict__.get('_formatters', {}).get(record.name)
        return str(own.format(record) if own else super().format(record))  # type: ignore[misc]


_classes: dict[type[logging.Handler], Any] = {}


def __getattr__(name: str) -> Any:
    handler = getattr(logging, name, getattr(logging.handlers, name, None))
    if not (isinstance(handler, type) and issubclass(handler, logging.Handler)):
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    if handler not in _classes:
        _classes[handler] = type(handler.__name__, (_PerLoggerFormatting, handler), {})
    return _classes[handler]
