# SPDX-License-Identifier: Apache-2.0
"""The user's terminal in a pod."""

from __future__ import annotations

import contextlib
import os
import select
import threading
from typing import Optional

from fogros2.errors import FogError
from fogros2.model import Command
from fogros2.shell import ssh_terminal
from fogros2.shell.kubernetes_channel import Channel
from fogros2.shell.kubernetes_link import Link


def attach(link: Link, command: Optional[Command]) -> int:
    """
    Connect standard input and output with a command there, or a login shell, until it ends.

    With a terminal on both sides the pod gives one too; else bytes go as they are.

    :return: its exit status; 255 if the connection was lost, as ssh has it.
    """
    terminal = None
    if os.isatty(0) and os.isatty(1):
        columns, rows = os.get_terminal_size(0)
        # one that tells no size, as of a program that only plays one, gets the usual
        terminal = (rows or 24, columns or 80, os.environ.get('TERM', 'dumb'))
    channel = link.open(command or Command(()), terminal=terminal, login=command is None)
    with contextlib.ExitStack() as undo:
        undo.callback(channel.close)
        if terminal is not None:
            undo.enter_context(ssh_terminal.raw())
            undo.enter_context(ssh_terminal.following_size(channel))
        _relay(channel)
        status = channel.recv_exit_status()
    return status if status >= 0 else 255


def _relay(channel: Channel) -> None:
    """Move bytes both ways until the pod's side has ended."""
    ended, end = os.pipe()

    def show() -> None:
        with contextlib.suppress(FogError, OSError):
            last = False
            while not last:
                out, err, last = channel.read(None)
                ssh_terminal.write(1, out)
                ssh_terminal.write(2, err)
        os.close(end)

    thread = threading.Thread(target=show, name='fog-screen', daemon=True)
    thread.start()
    sources = [ended, 0]
    while True:
        ready, _, _ = select.select(sources, [], [])
        if ended in ready:
            break
        data = os.read(0, 1 << 15)
        try:
            if data:
                channel.sendall(data)
            else:
                channel.shutdown_write()
                sources.remove(0)
        except (OSError, FogError):
            break  # it has ended meanwhile
    thread.join()
    os.close(ended)
