# SPDX-License-Identifier: Apache-2.0
"""Connect the user's terminal to a program on a machine: raw keys, output, and window size."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
import termios
import threading
import tty
from typing import Optional

from fogros2.shell import relay
from fogros2.shell.lines import Channel

#: Seconds between two looks at the size of the terminal.
LOOK = 0.1


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
    ended = threading.Event()

    def follow() -> None:
        sent = None  # the size may have changed since the channel was opened
        with contextlib.suppress(Exception):  # one of the two has ended
            while not ended.wait(LOOK):
                size = os.get_terminal_size(0)
                if size != sent:
                    channel.resize_pty(*size)
                    sent = size

    thread = threading.Thread(target=follow, name='fog-terminal-size', daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(5.0)
