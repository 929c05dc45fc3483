# SPDX-License-Identifier: Apache-2.0
"""What an executor and a node know of the things that have callbacks."""

from collections.abc import Callable
import struct
from typing import Any

from rclpy._dds import Reader
from rclpy.exceptions import InvalidHandle

Work = tuple[Callable[..., Any], tuple[Any, ...], Callable[[Any], None] | None]
"""A callback, its arguments, and what is done with its result."""


class Entity:
    """
    The base of publishers, subscriptions, timers, services, clients, guard conditions and events.

    :param ends: what it holds of DDS, to be closed when it is destroyed.
    """

    callback_group: Any = None
    _destroyed = False
    _reader: Reader
    _logger_name: str

    def __init__(self, *ends: Any) -> None:
        self._ends = list(ends)

    def _handle(self) -> int | None:
        """What triggers it in a wait set; None: nothing."""
        return None

    def _is_triggered(self) -> bool:
        """Whether there really is something, once its handle has triggered."""
        return True

    def _take(self, executor: Any) -> Work | None:
        """Take what is there; None if there is nothing after all."""
        return None

    def _check_alive(self) -> None:
        if self._destroyed:
            raise InvalidHandle('cannot use Destroyable because destruction was requested')

    def _read(self, parse: Callable[[Any], Any], what: str) -> tuple[Any, Any]:
        """Take the next sample that can be parsed, and what it gives; else (None, None)."""
        for sample in () if self._destroyed else self._reader.take():
            try:
                return sample, parse(sample.data)
            except (ValueError, struct.error) as error:
                from rclpy.logging import get_logger
                get_logger(self._logger_name).error(f'Dropped {what}: {error}')
        return None, None

    def destroy(self) -> None:
        """Free it; a program calls a node's ``destroy_publisher()`` and so on."""
        if not self._destroyed:
            self._destroyed = True
            for end in self._ends:
                end.close()
