# SPDX-License-Identifier: Apache-2.0
"""Show progress in the terminal: failed steps, and how long some work takes."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import shutil
import sys
import threading
import time
from typing import Optional

from fogros2 import waiting
from fogros2.report import Event, redraws, StepFailed
from fogros2.untrusted import one_line
from ros2fog_cli.api.output import uncleaned

#: Seconds without a line, if there is no terminal.
STILL = 30.0
#: Seconds between two looks at the clock.
TICK = 1.0


def report(event: Event) -> None:
    """Print a failed step to standard error; a :data:`fogros2.report.Reporter`."""
    if isinstance(event, StepFailed):
        where = f'{event.machine}: ' if event.machine else ''
        with aside():
            _write(f'{where}{event.step} failed: {event.reason}\n')


def _write(text: str) -> None:
    with contextlib.suppress(OSError):  # the terminal is closed, and the work goes on
        print(text, end='', file=sys.stderr, flush=True)


def _redraw(text: str = '') -> None:
    """Replace the last line of the terminal."""
    with contextlib.suppress(OSError):
        print(f'\r\x1b[K{one_line(text)}', end='', file=uncleaned(sys.stderr), flush=True)


class _Working:
    """The running time of some work."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._begin = self._told = time.monotonic()
        self._live = redraws(sys.stderr)
        self._drawn = False

    def tick(self) -> None:
        with _LOCK:
            if self is not _working:
                return
            now = time.monotonic()
            doing = ', '.join(waiting.everything())
            doing = f' ({doing})' * bool(doing)
            if self._live:
                text = f'{self._what} {now - self._begin:.0f} s{doing}'
                _redraw(text[:shutil.get_terminal_size().columns - 1])
                self._drawn = True
            elif now - self._told >= STILL:
                self._told = now
                _write(f'still {self._what} after {now - self._begin:.0f} s{doing}\n')

    def erase(self) -> None:
        if self._drawn:
            _redraw()
        self._drawn = False


#: Held while something is printed.
_LOCK = threading.RLock()
_working: Optional[_Working] = None


@contextlib.contextmanager
def working(what: str) -> Iterator[None]:
    """
    Show that a block works: its running time on a terminal, else a line every 30 seconds.

    :param what: such as 'deleting'.
    """
    global _working
    mine = _working = _Working(what)
    ended = threading.Event()
    waiting.Periodic('fog-progress', TICK, mine.tick, stop=ended)
    try:
        yield
    finally:
        ended.set()
        with _LOCK:
            mine.erase()
            _working = None


@contextlib.contextmanager
def aside() -> Iterator[None]:
    """Let a block print while something works."""
    with _LOCK:
        if _working is not None:
            _working.erase()
        yield
