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
from fogros2.model import Command, Endpoint, Result
from fogros2.shell import command_line, proxy, relay, Stream, sync
from fogros2.shell.lines import LineStream


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
        stream = LineStream(proxy.dial(command_line.quiet(command), None), self.name)
        stream.write(command.input)
        return stream

    def interactive(self, command: Optional[Command] = None) -> int:
        """Run the user's shell, or ``command``, in this terminal."""
        words = [os.environ.get('SHELL', '/bin/sh')] if command is None else process.argv(command)
        environment = {**os.environ, **(command.environment if command else {})}
        return subprocess.call(words, env=environment)

    def close(self) -> None:
        """Do nothing: there is no connection."""
