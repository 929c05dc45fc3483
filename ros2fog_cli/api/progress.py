# SPDX-License-Identifier: Apache-2.0
"""What goes on, shown by a verb: steps that fail, and a line that tells how far a wait is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import sys

from fogros2.report import Event, Reporter, StepFailed


@contextlib.contextmanager
def shown() -> Iterator[Reporter]:
    """Yield a Reporter that prints the steps that fail on the standard error."""
    def report(event: Event) -> None:
        if isinstance(event, StepFailed):
            where = f'{event.machine}: ' if event.machine else ''
            print(f'{where}{event.step} failed: {event.reason}', file=sys.stderr)

    yield report


@contextlib.contextmanager
def line() -> Iterator[Callable[[str], None]]:
    """Yield what shows a text on a line of the terminal, in place of the one before."""
    shown_now = ''

    def show(text: str) -> None:
        nonlocal shown_now
        if sys.stderr.isatty():
            print(f'\r\x1b[K{text}', end='', file=sys.stderr, flush=True)
            shown_now = text
        elif text.split(',')[0] != shown_now:
            # into a file: once for each state, not for each second
            shown_now = text.split(',')[0]
            print(shown_now, file=sys.stderr, flush=True)

    try:
        yield show
    finally:
        if shown_now and sys.stderr.isatty():
            print('\r\x1b[K', end='', file=sys.stderr, flush=True)
