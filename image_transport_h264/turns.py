# SPDX-License-Identifier: Apache-2.0
"""
Let the nodes of one computer send large messages in turn.

Two raw images at once on a slow link are worse than one after the other. Each fills the link's
queue, most parts of both are lost there, and repeated parts of one delay the other.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import fcntl
import os
from pathlib import Path
import time

#: Poll interval of the lock in seconds; on a link of 1 Gbit/s, the smallest image that takes turns
#: takes as long.
_LOOK = 0.002


class Turns:
    """
    Take turns by advisory locks on existing files, so that no lock file is created.

    The kernel frees the locks of a dead process. A process that had its turn cannot take the next
    one before a waiting process: the next in line holds a second lock while it waits.

    :param path: a file that is the same for all processes; its folder is the second lock.
    """

    def __init__(self, path: Path = Path(__file__)) -> None:
        self._files: list[int] = []
        for one in (path, path.parent):
            # Inside an archive there is no such file; all nodes then send at once.
            with contextlib.suppress(OSError):
                self._files.append(os.open(one, os.O_RDONLY | os.O_CLOEXEC))

    def close(self) -> None:
        """Close the files."""
        while self._files:
            os.close(self._files.pop())

    @contextlib.contextmanager
    def taken(self, longest: float) -> Iterator[bool]:
        """
        Wait for the turn, and hold it until the block ends.

        :param longest: seconds to wait; then continue without the turn, because a process that
            hangs must not block the others.
        :return: whether this process has the turn.
        """
        deadline = time.monotonic() + longest
        ours = len(self._files) == 2 and _lock(self._files[1], deadline)
        if ours:
            ours = _lock(self._files[0], deadline)
            fcntl.flock(self._files[1], fcntl.LOCK_UN)
        try:
            yield ours
        finally:
            if ours:
                fcntl.flock(self._files[0], fcntl.LOCK_UN)


def _lock(file: int, deadline: float) -> bool:
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= deadline:
                return False
            time.sleep(_LOOK)
        except OSError:
            return False  # a network file system without locks
        else:
            return True
