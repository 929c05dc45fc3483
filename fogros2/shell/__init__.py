# SPDX-License-Identifier: Apache-2.0
"""The seam to a machine's command line: run, put, sync, open."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
import threading
from typing import Optional, Protocol

from fogros2 import plugin_system
from fogros2.model import Command, Endpoint, Result, SyncReport


class Stream(Protocol):
    """Both ends of a program that runs on the machine, line by line."""

    def write(self, data: bytes) -> None:
        """
        Send to its standard input.

        :raises ConnectError: the connection is gone.
        """

    def readline(self) -> bytes:
        """Return its next line of output with the newline, b'' once it or the link has ended."""

    def close(self) -> None:
        """End it; a ``readline`` in another thread returns b''."""


class Shell(Protocol):
    """
    A machine's command line; one connection, kept, opened again after a loss; thread-safe.

    ``Command.sudo`` runs as root: ``sudo -n`` unless the login user is root already.
    """

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
        on_output: Optional[Callable[[str], None]] = None,
    ) -> Result:
        """
        Run a command there and wait for it.

        :raises CommandError: it exited with a status other than zero, and ``check`` is set.
        :raises ConnectError: the machine can't be reached.
        :raises HostKeyError: another host key than the pinned one.
        :raises AuthenticationError: our key was refused.
        :raises DeadlineExceeded: out of time.
        """

    def put(self, data: bytes, target: str, *, mode: int, timeout: float = 60.0) -> None:
        """Write a file there (folders made as needed): aside first, then moved into place."""

    def sync(
        self, source: Path, target: str, *, excludes: Sequence[str], timeout: float,
        includes: Sequence[str] = (), cancel: Optional[threading.Event] = None,
        on_progress: Optional[Callable[[int, int], None]] = None,
    ) -> SyncReport:
        """
        Make the folder ``target`` there equal ``source`` here but for ``excludes``.

        :param excludes: rsync patterns; what matches is neither sent nor deleted there.
        :param includes: rsync patterns that win over ``excludes``.
        :param on_progress: gets bytes done and bytes in all (0: unknown).
        """

    def open(self, command: Command) -> Stream:
        """Start a program there and return its streams; it ends with the stream."""

    def interactive(self, command: Optional[Command] = None) -> int:
        """
        Give the user's terminal to the login shell there, or to ``command``.

        Returns the exit status.
        """

    def close(self) -> None:
        """Drop the connection; the next call would open it again."""


def warm(kind: str) -> None:
    """
    Begin to load what shells of a kind need, without waiting for it.

    :raises PrerequisiteError: it isn't installed.
    """
    begin = getattr(plugin_system.load('fogros2.shell', kind), 'warm', None)
    if begin is not None:
        begin()


def connect(endpoint: Endpoint, *, name: str, timeout: float = 30.0) -> Shell:
    """
    Return the Shell for an endpoint, by its kind; connects when first used.

    :param name: the machine's name, for messages.
    :param timeout: seconds one attempt to connect may take.
    """
    shell: Shell = plugin_system.load('fogros2.shell', endpoint.kind)(
        endpoint, name=name, timeout=timeout)
    return shell
