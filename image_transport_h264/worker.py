# SPDX-License-Identifier: Apache-2.0
"""Run work on the newest items in a thread, with a bounded queue."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import threading
from typing import Generic, TypeVar

Item = TypeVar('Item')


class Worker(Generic[Item]):
    """
    Pass items to ``work`` in a thread.

    :param waiting: maximum number of waiting items; a further one replaces the oldest.
    :param failed: callback after ``work`` raised, which ends the thread.
    """

    def __init__(
        self, name: str, work: Callable[[Item], None], failed: Callable[[], None],
        waiting: int = 1,
    ) -> None:
        self._work, self._failed = work, failed
        self._items: deque[Item] = deque(maxlen=waiting)
        self._news = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Queue an item, and return at once."""
        with self._news:
            self._items.append(item)
            self._news.notify()

    @property
    def waiting(self) -> int:
        """Number of waiting items."""
        return len(self._items)

    def stop(self) -> None:
        """Stop the thread after its current item; drop the waiting items."""
        with self._news:
            self._stopping = True
            self._news.notify()
        self._thread.join(5.0)

    def _run(self) -> None:
        try:
            while True:
                with self._news:
                    self._news.wait_for(lambda: self._items or self._stopping)
                    if self._stopping:
                        return
                    item = self._items.popleft()
                self._work(item)
                # Free the picture while the thread waits for the next one.
                del item
        except BaseException:
            self._failed()
            raise
