# SPDX-License-Identifier: Apache-2.0
"""Keep launch's log files within a limit, although a machine may print without end."""

from __future__ import annotations

import contextlib
from pathlib import Path

import launch.logging

#: Maximum bytes of a log file, of which one earlier part stays; bytes between two looks.
LIMIT, LOOK = 64 << 20, 1 << 20


class LogFiles:
    """The log files of this launch; launch opens a file again that has been renamed."""

    def __init__(self) -> None:
        self._size = 0

    def add(self, size: int) -> None:
        """Note that so many bytes may have been written; rename files that are too large."""
        self._size += size
        if self._size < LOOK:
            return
        self._size = 0
        with contextlib.suppress(OSError):
            for path in Path(launch.logging.launch_config.log_dir).glob('*.log'):
                if path.stat().st_size > LIMIT:
                    path.replace(f'{path}.1')
