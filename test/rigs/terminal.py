# SPDX-License-Identifier: Apache-2.0
"""A command on a terminal of its own, and what it draws there."""

from __future__ import annotations

from collections.abc import Callable
import fcntl
import os
from pathlib import Path
import pty
import select
import signal
import struct
import subprocess
import termios
import time
from typing import Optional

from rigs.launched import WITH_SIGINT


def screen(
    *words: str, until: Callable[[str], bool], columns: int = 100, timeout: float = 40.0,
    folder: Optional[Path] = None,
) -> str:
    """
    Return what a command draws until it ends; Ctrl-C is pressed once.

    :param until: whether Ctrl-C is pressed after this text.
    :param timeout: seconds until Ctrl-C is pressed all the same.
    :param folder: that the command runs in.
    :raises AssertionError: it ends with another status than 0, or not within 60 s of Ctrl-C.
    """
    terminal, theirs = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack('HHHH', 40, columns, 0, 0))
    # in our session: sudo's ticket belongs to the terminal
    child = subprocess.Popen([*WITH_SIGINT, *words], stdin=theirs, stdout=theirs, stderr=theirs,
                             cwd=folder, env={**os.environ, 'TERM': 'xterm'})
    os.close(theirs)
    said, pressed = b'', False
    deadline = time.monotonic() + timeout
    try:
        while time.monotonic() < deadline or not pressed:
            if not pressed and (until(said.decode(errors='replace'))
                                or time.monotonic() > deadline):
                said += b'^C'
                os.killpg(child.pid, signal.SIGINT)
                pressed, deadline = True, time.monotonic() + 60.0
            if select.select([terminal], [], [], 0.2)[0]:
                try:
                    more = os.read(terminal, 65536)
                except OSError:
                    break  # the command has ended
                said += more
        text = said.decode()
        assert child.wait(60) == 0, text
        return text
    finally:
        os.close(terminal)
        child.kill()
