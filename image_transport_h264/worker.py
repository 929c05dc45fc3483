# SPDX-License-Identifier: Apache-2.0
"""A thread that works on the newest item and holds at most one more, so that nothing queues."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import threading
from typing import Generic, TypeVar

Item = TypeVar('Item')


class Worker(Generic[Item]):
    """
    Hands items to ``work`` in a thread of its own.

    :param waiting: items that may wait; a further one pushes the oldest out.
    :param failed: called when ``work`` has raised, which ends the thread.
    """

    def __init__(
        self, name: str, work: Callable[[Item], None], failed: Callable[[], None],
        waiting: int = 1,
    ) -> None:
        self._work, self._failed = work, failed
        self._items: deque[Item] = deque()
        self._waiting = waiting
        self._news = threading.Condition()
        self._stopping = False
        #: Items that were pushed out.
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> bool:
        """Hand an item over and return at once: whether none had to go for it."""
        with self._news:
            whole = len(self._items) < self._waiting
            if not whole:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
            self._news.notify()
            return whole

    @property
    def waiting(self) -> int:
        """Items that wait."""
        return len(self._items)

    def stop(self) -> None:
        """End the thread after the item it works on; what waits is dropped."""
        with self._news:
            self._stopping = True
            self._news.notify()
        self._thread.join(5.0)

    def _run(self) -> None:
        stopped = False
        try:
            self._loop()
            stopped = True
        finally:
            if not stopped:
                self._failed()

    def _loop(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._items or self._stopping)
                if self._stopping:
                    return
                item = self._items.popleft()
            self._work(item)
            # nothing may keep a picture alive while the thread waits
            del item
