# SPDX-License-Identifier: Apache-2.0
"""Change the shell of a machine while the shell is in use."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
import contextlib
from pathlib import Path
import threading
from typing import Optional

from fogros2.model import Command, Result, SyncReport
from fogros2.shell import Shell, Stream

#: Seconds to wait for the commands on a shell that is replaced.
DRAIN = 3.0


class MovableShell:
    """
    A Shell that forwards all calls to another Shell, which can be replaced.

    :param shell: the first shell.
    """

    def __init__(self, shell: Shell) -> None:
        self._shell = shell
        self._calls: Counter[int] = Counter()
        self._news = threading.Condition()

    def move(self, shell: Shell) -> None:
        """
        Use another shell to the same machine from now on, and close the previous one.

        Open streams end. The method waits up to ``DRAIN`` seconds for running commands: on a
        closed shell, they would connect again, although the firewall no longer admits them.
        """
        with self._news:
            before, self._shell = self._shell, shell
            self._news.wait_for(lambda: not self._calls[id(before)], DRAIN)
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
        """Run a command on the machine, and wait for its end; see the protocol."""
        with self._current() as shell:
            return shell.run(
                command, timeout=timeout, check=check, cancel=cancel, on_output=on_output)

    def put(self, data: bytes, target: str, *, mode: int, timeout: float = 60.0) -> None:
        """Write a file atomically, and create its folders; see the protocol."""
        with self._current() as shell:
            shell.put(data, target, mode=mode, timeout=timeout)

    def sync(
        self, source: Path, target: str, *, excludes: Sequence[str], timeout: float,
        includes: Sequence[str] = (), cancel: Optional[threading.Event] = None,
        on_progress: Optional[Callable[[int, int], None]] = None,
    ) -> SyncReport:
        """Make the folder ``target`` on the machine equal to ``source``; see the protocol."""
        with self._current() as shell:
            return shell.sync(
                source, target, excludes=excludes, timeout=timeout, includes=includes,
                cancel=cancel, on_progress=on_progress)

    def fetch(
        self, source: str, target: Path, *, known: Optional[Path], timeout: float,
        cancel: Optional[threading.Event] = None,
    ) -> None:
        """Make the local folder ``target`` equal to the machine's ``source``; see the protocol."""
        with self._current() as shell:
            shell.fetch(source, target, known=known, timeout=timeout, cancel=cancel)

    def open(self, command: Command) -> Stream:
        """Start a program on the machine; closing the returned stream ends the program."""
        with self._current() as shell:
            return shell.open(command)

    def interactive(self, command: Optional[Command] = None) -> int:
        """Connect the user's terminal to the login shell, or to ``command``."""
        return self._shell.interactive(command)

    def close(self) -> None:
        """Close the connection; the next call opens a new one."""
        self._shell.close()
