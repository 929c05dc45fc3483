# SPDX-License-Identifier: Apache-2.0
"""Run commands on this computer through the Shell interface, beside the robot's nodes."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import getpass
import os
import subprocess
import threading
from typing import Optional

from fogros2 import process
from fogros2.errors import ConnectError, PrerequisiteError
from fogros2.model import Command, Endpoint, Result
from fogros2.shell import relay, Stream, sync


class LocalShell(sync.RsyncShell):
    """A Shell for endpoints of kind 'local'; it has no connection."""

    where = process.HERE

    def __init__(self, endpoint: Endpoint, *, name: str, timeout: float = 30.0) -> None:
        self.endpoint = endpoint
        self.name = name
        self.user = endpoint.user or getpass.getuser()

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
        on_output: Optional[Callable[[str], None]] = None,
    ) -> Result:
        """Run a command, and wait for its end; see the protocol."""
        return process.run(
            command, timeout=timeout, check=check, cancel=cancel, on_output=on_output)

    def _remote_shell(self) -> contextlib.AbstractContextManager[relay.RemoteShell]:
        return contextlib.nullcontext(({}, (), []))

    def open(self, command: Command) -> Stream:
        """Start a program; closing the returned stream ends the program."""
        try:
            child = process.start(
                command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL,
                environment={**os.environ, **command.environment})
        except FileNotFoundError as error:
            raise PrerequisiteError(f'{error.filename} not found on this computer',
                                    'ros2 fog doctor names the package that brings it') from error
        stream = LocalStream(child)
        if command.input:
            stream.write(command.input)
        return stream

    def interactive(self, command: Optional[Command] = None) -> int:
        """Run the user's shell, or ``command``, in this terminal."""
        words = [os.environ.get('SHELL', '/bin/sh')] if command is None else process.argv(command)
        environment = {**os.environ, **(command.environment if command else {})}
        return subprocess.call(words, env=environment)

    def close(self) -> None:
        """Do nothing: there is no connection."""


class LocalStream:
    """Standard input and output of a program on this computer, line by line."""

    def __init__(self, child: subprocess.Popen[bytes]) -> None:
        self._child = child

    def write(self, data: bytes) -> None:
        """Send bytes to the program's standard input."""
        assert self._child.stdin is not None
        try:
            self._child.stdin.write(data)
            self._child.stdin.flush()
        except (OSError, ValueError) as error:
            raise ConnectError(f'the program has ended: {error}') from error

    def readline(self) -> bytes:
        """Return the next line of output with its newline, b'' at the end."""
        assert self._child.stdout is not None
        return self._child.stdout.readline()

    def close(self) -> None:
        """End the program; a ``readline`` in another thread returns b''."""
        self._child.terminate()
        if self._child.stdin is not None:
            try:
                self._child.stdin.close()
            except BrokenPipeError:
                pass  # the program ended before it read all input
        try:
            self._child.wait(2.0)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
