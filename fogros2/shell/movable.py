# SPDX-License-Identifier: Apache-2.0
"""A shell whose machine can be reached another way from some moment on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
import contextlib
from pathlib import Path
import threading
from typing import Optional

from fogros2.model import Command, Result, SyncReport
from fogros2.shell import Shell, Stream

#: Seconds that a shell which is left may take to end what runs on it.
PATIENCE = 3.0


class MovableShell:
    """
    A Shell that hands everything to another one, which can be replaced.

    :param shell: the one to begin with.
    """

    def __init__(self, shell: Shell) -> None:
        self._shell = shell
        self._calls: Counter[int] = Counter()
        self._news = threading.Condition()

    def move(self, shell: Shell) -> None:
        """
        Take another shell to the same machine from now on, and close the one before.

        Streams that are open end. What runs at this moment is waited for, some seconds at the
        most: on a shell that was closed it would connect anew, where nobody lets it in any more.
        """
        with self._news:
            before, self._shell = self._shell, shell
            self._news.wait_for(lambda: not self._calls[id(before)], PATIENCE)
        before.close()

    @contextlib.contextmanager
    def _current(self) -> Iterator[Shell]:
        with self._news:
            shell = self._shell
            self._calls[id(shell)] += 1
        try:
            yield shell
        finally:
            with self._news:
                self._calls[id(shell)] -= 1
                self._news.notify_all()

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
        on_output: Optional[Callable[[str], None]] = None,
    ) -> Result:
        """Run a command there and wait for it; see the protocol."""
        with self._current() as shell:
            return shell.run(
                command, timeout=timeout, check=check, cancel=cancel, on_output=on_output)

    def put(self, data: bytes, target: str, *, mode: int, timeout: float = 60.0) -> None:
        """Write a file there (folders made as needed): aside first, then moved into place."""
        with self._current() as shell:
            shell.put(data, target, mode=mode, timeout=timeout)

    def sync(
        self, source: Path, target: str, *, excludes: Sequence[str], timeout: float,
        includes: Sequence[str] = (), cancel: Optional[threading.Event] = None,
        on_progress: Optional[Callable[[int, int], None]] = None,
    ) -> SyncReport:
        """Make the folder ``target`` there equal ``source`` here; see the protocol."""
        with self._current() as shell:
            return shell.sync(
                source, target, excludes=excludes, timeout=timeout, includes=includes,
                cancel=cancel, on_progress=on_progress)

    def open(self, command: Command) -> Stream:
        """Start a program there and return its streams; it ends with the stream."""
        with self._current() as shell:
            return shell.open(command)

    def interactive(self, command: Optional[Command] = None) -> int:
        """Give the user's terminal to the login shell there, or to ``command``."""
        return self._shell.interactive(command)

    def close(self) -> None:
        """Drop the connection; the next call would open it again."""
        self._shell.close()
