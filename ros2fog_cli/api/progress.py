# SPDX-License-Identifier: Apache-2.0
"""Steps of the core, shown by a verb: failures as they come."""

from __future__ import annotations

from collections.abc import Iterator
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
