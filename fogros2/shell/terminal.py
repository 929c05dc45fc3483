# SPDX-License-Identifier: Apache-2.0
"""The user's terminal on a machine: raw keys there, screen here, the window's size followed."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
import signal
import termios
import threading
import tty
from types import FrameType
from typing import Optional, Protocol

from fogros2.shell import relay


class Terminal(relay.Channel, Protocol):
    """A program on a machine, which may have a terminal there."""

    def resize_pty(self, width: int, height: int, /) -> None:
        """Take a new size."""


def size() -> Optional[tuple[int, int, str]]:
    """Return rows, columns and kind of this process's terminal, None without one."""
    if not (os.isatty(0) and os.isatty(1)):
        return None
    columns, rows = os.get_terminal_size(0)
    # one that tells no size, as of a program that only plays one, gets the usual
    return rows or 24, columns or 80, os.environ.get('TERM', 'dumb')


def attach(channel: Terminal, *, keys: bool) -> int:
    """
    Connect standard input and output with a program on a machine until it ends.

    :param keys: whether both sides have a terminal; else bytes go as they are.
    :return: its exit status; 255 if the connection was lost, as ssh has it.
    """
    with contextlib.ExitStack() as undo:
        if keys:
            undo.enter_context(_raw())
            undo.enter_context(_following_size(channel))
        return relay.relay(channel, 0, 1, 2)


@contextlib.contextmanager
def _raw() -> Iterator[None]:
    """Hand keys over as they are pressed, as long as the block runs."""
    before = termios.tcgetattr(0)
    tty.setraw(0, termios.TCSADRAIN)  # what was typed ahead is kept
    try:
        yield
    finally:
        termios.tcsetattr(0, termios.TCSADRAIN, before)


@contextlib.contextmanager
def _following_size(channel: Terminal) -> Iterator[None]:
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
