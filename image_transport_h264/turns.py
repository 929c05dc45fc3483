# SPDX-License-Identifier: Apache-2.0
"""
One large message at a time from this computer: what several nodes agree on without talking.

Two raw images at once on a slow link are worse than one after the other: each fills the link's
queue, most of both is lost there, and what is sent again for one is in the way of the other.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import fcntl
import os
from pathlib import Path
import time

#: Seconds between two looks at who has the turn; the smallest image that waits takes as long on a
#: link of 1 Gbit/s.
_LOOK = 0.002


class Turns:
    """
    Advisory locks on what is there anyway, so that nothing is made; the kernel frees a dead one's.

    A process that has the turn can't take it again before one that waits: the next in line holds a
    second lock until its turn comes.

    :param path: a file, the same for all who take turns; its folder stands for the line.
    """

    def __init__(self, path: Path = Path(__file__)) -> None:
        self._files: list[int] = []
        for one in (path, path.parent):
            # as part of an archive it is no file, and everybody goes at once, as without this
            with contextlib.suppress(OSError):
                self._files.append(os.open(one, os.O_RDONLY | os.O_CLOEXEC))

    def close(self) -> None:
        """Let go of the files."""
        while self._files:
            os.close(self._files.pop())

    @contextlib.contextmanager
    def taken(self, longest: float) -> Iterator[bool]:
        """
        Wait for the turn and have it until the block ends.

        :param longest: seconds to wait; then it goes on without the turn, as one who hangs must
            not hold up the others for ever.
        :return: whether it is ours.
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
            return False  # a network's file system that knows no locks
        else:
            return True
