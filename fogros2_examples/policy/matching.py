# SPDX-License-Identifier: Apache-2.0
"""Match messages of several topics by their stamps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Optional

#: Nanoseconds by which stamps go back where a clock was set back.
SET_BACK = 1_000_000_000


class Matcher:
    """
    Messages that wait for those that belong to them.

    :param most: how many messages of each topic wait; the first topic's stamps count.
    :param tolerance: most nanoseconds between the first one's stamp and another's.
    """

    def __init__(self, most: Mapping[str, int], tolerance: int) -> None:
        self._most = most
        self._waiting: dict[str, dict[int, Any]] = {name: {} for name in most}
        self._tolerance = tolerance
        self._last = -1

    def add(self, name: str, stamp: int, message: Any) -> None:
        """Keep a message; forget the first one of its topic if there are too many."""
        if stamp < self._last - SET_BACK:
            self._last = -1
            self._waiting = {topic: {} for topic in self._most}
        waiting = self._waiting[name]
        waiting[stamp] = message
        if len(waiting) > self._most[name]:
            del waiting[next(iter(waiting))]

    def newest(self) -> Optional[dict[str, Any]]:
        """
        Return the newest messages that belong together, by topic; None without new ones.

        The first topic's stamps increase from one answer to the next.
        """
        first = next(iter(self._waiting.values()))
        for stamp in sorted((one for one in first if one > self._last), reverse=True):
            nearest = {
                name: min(waiting, key=lambda one: abs(one - stamp), default=-SET_BACK)
                for name, waiting in self._waiting.items()}
            if all(abs(one - stamp) <= self._tolerance for one in nearest.values()):
                self._last = stamp
                return {name: self._waiting[name][one] for name, one in nearest.items()}
        return None
