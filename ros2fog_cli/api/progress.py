# SPDX-License-Identifier: Apache-2.0
"""Show progress in the terminal: failed steps, and one line for a wait."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import sys

from fogros2.report import Event, StepFailed
from fogros2.untrusted import one_line
from ros2fog_cli.api.output import uncleaned


def report(event: Event) -> None:
    """Print a failed step to standard error; a :data:`fogros2.report.Reporter`."""
    if isinstance(event, StepFailed):
        where = f'{event.machine}: ' if event.machine else ''
        with contextlib.suppress(OSError):  # the terminal is closed, and the work goes on
            print(f'{where}{event.step} failed: {event.reason}', file=sys.stderr)


@contextlib.contextmanager
def line() -> Iterator[Callable[[str], None]]:
    """Yield a function that shows a text on one terminal line and replaces the previous text."""
    shown_now = ''

    def show(text: str) -> None:
        nonlocal shown_now
        if sys.stderr.isatty():
            print(f'\r\x1b[K{one_line(text)}', end='', file=uncleaned(sys.stderr), flush=True)
            shown_now = text
        elif text.split(',')[0] != shown_now:
            # Not a terminal: print each state once, not every second.
            shown_now = text.split(',')[0]
            print(shown_now, file=sys.stderr, flush=True)

    try:
        yield show
    finally:
        if shown_now and sys.stderr.isatty():
            print('\r\x1b[K', end='', file=uncleaned(sys.stderr), flush=True)
