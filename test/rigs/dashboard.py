# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog dashboard`` as a process of a test's own."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess


class Dashboard:
    """A dashboard; ``url`` is the address of its page."""

    def __init__(self) -> None:
        # in our session: sudo's ticket belongs to the terminal
        self.child = subprocess.Popen(
            ['ros2', 'fog', 'dashboard', '--no-browser'], stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, text=True, preexec_fn=os.setpgrp)
        assert self.child.stdout is not None
        self.url = self.child.stdout.readline().split()[4]

    def seconds(self) -> float:
        """Return how much of a processor it has had, with what it started and what has ended."""
        times = Path(f'/proc/{self.child.pid}/stat').read_text().rpartition(')')[2].split()[11:15]
        return sum(map(int, times)) / os.sysconf('SC_CLK_TCK')

    def close(self) -> int:
        """Press Ctrl-C, and return its exit status."""
        self.child.send_signal(signal.SIGINT)
        try:
            code = self.child.wait(60)
        finally:
            self.child.kill()
        assert self.child.stdout is not None
        self.child.stdout.close()
        return code
