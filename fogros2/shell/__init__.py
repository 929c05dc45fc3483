# SPDX-License-Identifier: Apache-2.0
"""
The plugin interface to a machine's command line: run, put, sync, open.

``command_line`` builds command lines for a login shell. ``flow`` keeps little of a long transfer
under way. ``multiplexer`` is a program on a machine that runs many commands over one connection,
and ``multiplexed`` the robot's end of it. ``ssh_config`` asks OpenSSH for the user's settings of a
host, ``known_hosts`` has the host keys, and ``proxy`` leads through programs; ``ssh_connection``
opens SSH connections. ``lines`` reads output. ``relay`` connects local streams to a program on a
machine (``rsh`` is rsync's end of it), ``terminal`` the user's terminal. ``sync`` calls rsync.
``local`` is the shell of this computer. ``remote`` is the base of the shells with a connection:
``ssh``, and pods by ``kubernetes_link`` and ``kubernetes``, the connection and the shell.
``movable`` replaces a shell in use, ``host_key`` a machine's host key.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from pathlib import Path
import threading
from typing import Optional, Protocol, TypeVar

from fogros2 import plugin_system
from fogros2.errors import ConnectError
from fogros2.model import Command, Endpoint, Result, SyncReport

T = TypeVar('T')
#: Attempts to copy a folder over connections that break.
ATTEMPTS = 3


class Stream(Protocol):
    """Standard input and output of a program on a machine, line by line."""

    def write(self, data: bytes) -> None:
        """
        Send bytes to the program's standard input.

        :raises ConnectError: the connection is lost.
        """

    def readline(self) -> bytes:
        """Return the next line of output with its newline, b'' after the end or a lost link."""

    def close(self) -> None:
        """End the program; a ``readline`` in another thread returns b''."""


class Shell(Protocol):
    """
    A machine's command line over one connection, which is reopened after a loss; thread-safe.

    ``Command.sudo`` runs the command as root: by ``sudo -n``, unless the login user is root.
    """

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
        on_output: Optional[Callable[[str], None]] = None,
    ) -> Result:
        """
        Run a command on the machine, and wait for its end.

        :param timeout: seconds until the command must have ended.
        :param on_output: callback for each line of standard output.
        :raises CommandError: the exit status is not zero, and ``check`` is set.
        :raises ConnectError: the machine cannot be reached, or the connection was lost.
        :raises HostKeyError: the host key differs from the pinned one.
        :raises AuthenticationError: the machine refused our key.
        :raises DeadlineExceeded: the command took longer than ``timeout`` seconds.
        :raises Cancelled: ``cancel`` was set.
        """

    def put(self, data: bytes, target: str, *, mode: int, timeout: float = 60.0) -> None:
        """Write a file atomically (to a temporary file, then renamed); create its folders."""

    def sync(
        self, source: Path, target: str, *, excludes: Sequence[str], timeout: float,
        includes: Sequence[str] = (), cancel: Optional[threading.Event] = None,
        on_progress: Optional[Callable[[int, int], None]] = None,
    ) -> SyncReport:
        """
        Make the folder ``target`` on the machine equal to the local ``source``.

        :param excludes: rsync patterns; matching files are neither sent nor deleted.
        :param includes: rsync patterns with precedence over ``excludes``.
        :param timeout: seconds without progress.
        :param on_progress: callback with the bytes sent and the total bytes (0: unknown).
        """

    def fetch(
        self, source: str, target: Path, *, known: Optional[Path], limit: int, timeout: float,
        cancel: Optional[threading.Event] = None,
    ) -> None:
        """
        Make the local folder ``target`` equal to the folder ``source`` on the machine.

        :param known: a local folder; files that are equal there become hard links to it.
        :param limit: bytes that ``target`` may take on this computer.
        :param timeout: seconds in which ``target`` does not grow.
        :raises DeadlineExceeded: nothing came for ``timeout`` seconds.
        """

    def open(self, command: Command) -> Stream:
        """Start a program on the machine; closing the returned stream ends the program."""

    def interactive(self, command: Optional[Command] = None) -> int:
        """
        Connect the user's terminal to the login shell, or to ``command``.

        Return the exit status.
        """

    def close(self) -> None:
        """Close the connection; the next call opens a new one."""


def retried(copy: Callable[[], T]) -> T:
    """
    Call ``sync`` up to ``ATTEMPTS`` times, while the connection is lost; rsync sends what lacks.

    :raises ConnectError: it was lost in each attempt.
    """
    for _ in range(ATTEMPTS - 1):
        with contextlib.suppress(ConnectError):
            return copy()
    return copy()


def warm(kind: str) -> None:
    """
    Start to import the libraries of a kind of shell in the background.

    :raises PrerequisiteError: a library is not installed.
    """
    begin = getattr(plugin_system.load('fogros2.shell', kind), 'warm', None)
    if begin is not None:
        begin()


def connect(endpoint: Endpoint, *, name: str, timeout: float = 30.0) -> Shell:
    """
    Return the Shell of an endpoint by the endpoint's kind; it connects at the first use.

    :param name: the machine's name, for messages.
    :param timeout: time-out of one attempt to connect, in seconds.
    """
    shell: Shell = plugin_system.load('fogros2.shell', endpoint.kind)(
        endpoint, name=name, timeout=timeout)
    return shell
