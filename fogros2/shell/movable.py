# SPDX-License-Identifier: Apache-2.0
"""A shell whose machine can be reached another way from some moment on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
import threading
from typing import Optional

from fogros2.model import Command, Result, SyncReport
from fogros2.shell import Shell, Stream


class MovableShell:
    """
    A Shell that hands everything to another one, which can be replaced.

    :param shell: the one to begin with.
    """

    def __init__(self, shell: Shell) -> None:
        self._shell = shell

    def move(self, shell: Shell) -> None:
        """
        Take another shell to the same machine from now on, and close the one before.

        Streams that are open end; what runs at this moment fails as by a lost connection.
        """
        before, self._shell = self._shell, shell
        before.close()

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
        on_output: Optional[Callable[[str], None]] = None,
    ) -> Result:
        """Run a command there and wait for it; see the protocol."""
        return self._shell.run(
            command, timeout=timeout, check=check, cancel=cancel, on_output=on_output)

    def put(self, data: bytes, target: str, *, mode: int, timeout: float = 60.0) -> None:
        """Write a file there (folders made as needed): aside first, then moved into place."""
        self._shell.put(data, target, mode=mode, timeout=timeout)

    def sync(
        self, source: Path, target: str, *, excludes: Sequence[str], timeout: float,
        includes: Sequence[str] = (), cancel: Optional[threading.Event] = None,
        on_progress: Optional[Callable[[int, int], None]] = None,
    ) -> SyncReport:
        """Make the folder ``target`` there equal ``source`` here; see the protocol."""
        return self._shell.sync(
            source, target, excludes=excludes, timeout=timeout, includes=includes,
            cancel=cancel, on_progress=on_progress)

    def open(self, command: Command) -> Stream:
        """Start a program there and return its streams; it ends with the stream."""
        return self._shell.open(command)

    def interactive(self, command: Optional[Command] = None) -> int:
        """Give the user's terminal to the login shell there, or to ``command``."""
        return self._shell.interactive(command)

    def close(self) -> None:
        """Drop the connection; the next call would open it again."""
        self._shell.close()
