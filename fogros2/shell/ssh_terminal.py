# SPDX-License-Identifier: Apache-2.0
"""The user's terminal on a machine: raw keys there, screen here, the window's size followed."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
import select
import signal
import termios
import threading
import tty
from types import FrameType
from typing import Optional, Protocol, TYPE_CHECKING

from fogros2.errors import ConnectError

if TYPE_CHECKING:
    import paramiko


class Resizable(Protocol):
    """A terminal somewhere else."""

    def resize_pty(self, width: int, height: int, /) -> None:
        """Take a new size."""


def attach(channel: paramiko.Channel, line: Optional[str], name: str) -> int:
    """
    Connect standard input and output with a command there, or a login shell, until it ends.

    With a terminal on both sides the machine gets one too; else bytes go as they are.

    :param line: the command line, or None for the login shell.
    :return: its exit status; 255 if the connection was lost, as ssh has it.
    :raises ConnectError: the machine gives no terminal.
    """
    import paramiko

    terminal = os.isatty(0) and os.isatty(1)
    try:
        if terminal:
            columns, rows = os.get_terminal_size(0)
            channel.get_pty(os.environ.get('TERM', 'dumb'), columns, rows)
        if line is None:
            channel.invoke_shell()
        else:
            channel.exec_command(line)
    except (paramiko.SSHException, OSError) as error:
        channel.close()
        raise ConnectError(f"'{name}' gives no terminal: {error}") from error
    with contextlib.ExitStack() as undo:
        undo.callback(channel.close)
        if terminal:
            undo.enter_context(raw())
            undo.enter_context(following_size(channel))
        _relay(channel)
        channel.settimeout(None)
        status = channel.recv_exit_status()
    return status if status >= 0 else 255


@contextlib.contextmanager
def raw() -> Iterator[None]:
    """Hand keys over as they are pressed, as long as the block runs."""
    before = termios.tcgetattr(0)
    tty.setraw(0, termios.TCSADRAIN)  # what was typed ahead is kept
    try:
        yield
    finally:
        termios.tcsetattr(0, termios.TCSADRAIN, before)


@contextlib.contextmanager
def following_size(channel: Resizable) -> Iterator[None]:
    """Tell a terminal over there each new size of this one, as long as the block runs."""
    def resized(number: int, frame: Optional[FrameType]) -> None:
        columns, rows = os.get_terminal_size(0)
        channel.resize_pty(columns, rows)

    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach the main thread alone
        return
    before = signal.signal(signal.SIGWINCH, resized)
    try:
        yield
    finally:
        signal.signal(signal.SIGWINCH, before)


def _relay(channel: paramiko.Channel) -> None:
    """Move bytes both ways until the machine's side has ended."""
    sources: list[paramiko.Channel | int] = [channel, 0]
    while True:
        ready, _, _ = select.select(sources, [], [])
        if channel in ready:
            while channel.recv_stderr_ready():
                write(2, channel.recv_stderr(1 << 15))
            if channel.recv_ready():
                write(1, channel.recv(1 << 15))
            elif channel.eof_received or channel.closed:
                if not channel.recv_stderr_ready():
                    return
        if 0 in ready:
            data = os.read(0, 1 << 15)
            try:
                if data:
                    channel.sendall(data)
                else:
                    channel.shutdown_write()
            except OSError:
                return  # it has ended meanwhile
            if not data:
                sources.remove(0)


def write(target: int, data: bytes) -> None:
    """Write all of it to a file descriptor."""
    while data:
        data = data[os.write(target, data):]
