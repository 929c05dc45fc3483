# SPDX-License-Identifier: Apache-2.0
"""Change the shell of a machine while the shell is in use."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import contextlib
import threading
from typing import Any, Optional

from fogros2.model import Command
from fogros2.shell import Shell

#: Seconds to wait for the commands on a shell that is replaced.
DRAIN = 3.0


def _forwarded(name: str) -> Any:
    """Return a method that calls the current shell's method of that name."""
    def method(shell: MovableShell, *values: Any, **options: Any) -> Any:
        with shell._current() as current:
            return getattr(current, name)(*values, **options)

    return method


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

    # Calls of the shell that is the current one when they begin; see the protocol.
    run, put, sync, fetch, open = map(_forwarded, ('run', 'put', 'sync', 'fetch', 'open'))

    def interactive(self, command: Optional[Command] = None) -> int:
        """Connect the user's terminal to the login shell, or to ``command``."""
        return self._shell.interactive(command)

    def close(self) -> None:
        """Close the connection; the next call opens a new one."""
        self._shell.close()
