# SPDX-License-Identifier: Apache-2.0
"""Connect the user's terminal to a program on a machine: raw keys, output, and window size."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
import signal
import termios
import threading
import tty
from types import FrameType
from typing import Optional

from fogros2.shell import relay
from fogros2.shell.lines import Channel


def size() -> Optional[tuple[int, int, str]]:
    """Return rows, columns and type of this process's terminal, None without a terminal."""
    if not (os.isatty(0) and os.isatty(1)):
        return None
    columns, rows = os.get_terminal_size(0)
    # A terminal without a size, such as a simulated one, gets the usual size.
    return rows or 24, columns or 80, os.environ.get('TERM', 'dumb')


def attach(channel: Channel, *, keys: bool) -> int:
    """
    Connect standard input and output to a program on a machine until the program ends.

    :param keys: whether both sides have a terminal; otherwise bytes are relayed unchanged.
    :return: exit status of the program; 255 if the connection was lost, as in ssh.
    """
    with contextlib.ExitStack() as undo:
        if keys:
            undo.enter_context(_raw())
            undo.enter_context(_following_size(channel))
        return relay.relay(channel, 0, 1, 2)


@contextlib.contextmanager
def _raw() -> Iterator[None]:
    """Set the terminal to raw mode for the block, so that each key is sent at once."""
    before = termios.tcgetattr(0)
    tty.setraw(0, termios.TCSADRAIN)  # keeps input that was typed ahead
    try:
        yield
    finally:
        termios.tcsetattr(0, termios.TCSADRAIN, before)


@contextlib.contextmanager
def _following_size(channel: Channel) -> Iterator[None]:
    """Send each new size of this terminal to the remote terminal during the block."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread can handle signals
        return
    changed, change = os.pipe()

    def send() -> None:
        while os.read(changed, 64):
            with contextlib.suppress(Exception):  # the program or this terminal has ended
                channel.resize_pty(*os.get_terminal_size(0))

    def resized(number: int, frame: Optional[FrameType]) -> None:
        # it must not send: the thread that it interrupts may hold the lock of the connection
        os.write(change, b'x')

    thread = threading.Thread(target=send, name='fog-terminal-size', daemon=True)
    thread.start()
    before = signal.signal(signal.SIGWINCH, resized)
    os.write(change, b'x')  # the size may have changed since the channel was opened
    try:
        yield
    finally:
        signal.signal(signal.SIGWINCH, before)
        os.close(change)  # ends the thread
        thread.join(5.0)
        os.close(changed)
