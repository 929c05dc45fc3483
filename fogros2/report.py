# SPDX-License-Identifier: Apache-2.0
"""Progress events of the core, for a logger, a progress bar or a test's list."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import os
import time
from typing import TextIO, Union

from fogros2.clock import ClockOffset


@dataclasses.dataclass(frozen=True)
class StepStarted:
    """A step of the deployment begins; ``machine`` is '' for the robot."""

    machine: str
    step: str


@dataclasses.dataclass(frozen=True)
class StepDone:
    """A step has ended after ``seconds``; ``detail`` is a short text for people."""

    machine: str
    step: str
    seconds: float
    detail: str = ''


@dataclasses.dataclass(frozen=True)
class StepFailed:
    """
    A step or an undo step failed after ``seconds``.

    :param fatal: the error also propagates, and is reported there too; otherwise only here.
    """

    machine: str
    step: str
    seconds: float
    reason: str
    fatal: bool = True


@dataclasses.dataclass(frozen=True)
class Progress:
    """The progress of a long step: ``done`` of ``total`` bytes (total 0: unknown)."""

    machine: str
    step: str
    done: int
    total: int


@dataclasses.dataclass(frozen=True)
class ClockMeasured:
    """The offset of a machine's clock changed; ``warn`` when it exceeds the limit."""

    machine: str
    offset: ClockOffset
    warn: bool = False


@dataclasses.dataclass(frozen=True)
class Warned:
    """Something may fail later that the launch does not end for; ``remedy`` is one line."""

    machine: str
    text: str
    remedy: str


@dataclasses.dataclass(frozen=True)
class Silence:
    """A machine has not answered for ``seconds``; ``over``: it answers again."""

    machine: str
    seconds: float
    over: bool = False


Event = Union[StepStarted, StepDone, StepFailed, Progress, ClockMeasured, Warned, Silence]
Reporter = Callable[[Event], None]


def size(number: float) -> str:
    """Return bytes as text with a decimal unit."""
    for unit in ('B', 'kB', 'MB', 'GB'):
        if number < 1000:
            return f'{number:.0f} {unit}' if unit == 'B' else f'{number:.1f} {unit}'
        number /= 1000
    return f'{number:.1f} TB'


def redraws(stream: TextIO) -> bool:
    """Return whether a stream is a terminal that replaces a line and shows colours."""
    return stream.isatty() and os.environ.get('TERM') != 'dumb'


def silent(event: Event) -> None:
    """Ignore an event."""


@contextlib.contextmanager
def step(
    report: Reporter, machine: str, name: str, *, fatal: bool = True,
) -> Iterator[list[str]]:
    """
    Report the start and end of a block as a step; yield a list for words of the detail.

    An exception is reported as StepFailed and propagates.

    :param fatal: whether the exception's handler reports it too.
    """
    detail: list[str] = []
    report(StepStarted(machine, name))
    begin = time.monotonic()
    try:
        yield detail
    except BaseException as error:
        report(StepFailed(machine, name, time.monotonic() - begin, str(error), fatal))
        raise
    report(StepDone(machine, name, time.monotonic() - begin, ', '.join(detail)))
