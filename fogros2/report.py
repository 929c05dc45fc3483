# SPDX-License-Identifier: Apache-2.0
"""Progress: the core emits these events; a logger, a progress bar or a test's list takes them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import time
from typing import Union

from fogros2.clock import ClockOffset


@dataclasses.dataclass(frozen=True)
class StepStarted:
    """A step of the deployment begins; ``machine`` is '' for the robot itself."""

    machine: str
    step: str


@dataclasses.dataclass(frozen=True)
class StepDone:
    """A step is over after ``seconds``; ``detail`` is a few words for people."""

    machine: str
    step: str
    seconds: float
    detail: str = ''


@dataclasses.dataclass(frozen=True)
class StepFailed:
    """
    A step failed after ``seconds``; an undo that failed is one too.

    :param fatal: the error goes on up and will be reported there too; otherwise this is all.
    """

    machine: str
    step: str
    seconds: float
    reason: str
    fatal: bool = True


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a long step is: ``done`` of ``total`` bytes (total 0: unknown)."""

    machine: str
    step: str
    done: int
    total: int


@dataclasses.dataclass(frozen=True)
class OutputLine:
    """A line from a step's program on the machine, worth showing at debug level."""

    machine: str
    line: str


@dataclasses.dataclass(frozen=True)
class ClockMeasured:
    """The offset of a machine's clock changed; ``warn`` once it is above the limit."""

    machine: str
    offset: ClockOffset
    warn: bool = False


Event = Union[StepStarted, StepDone, StepFailed, Progress, OutputLine, ClockMeasured]
Reporter = Callable[[Event], None]


def silent(event: Event) -> None:
    """Take an event and show nothing."""


@contextlib.contextmanager
def step(
    report: Reporter, machine: str, name: str, *, fatal: bool = True,
) -> Iterator[list[str]]:
    """
    Report a step's start and end around the block; yields a list that takes the detail words.

    An exception is reported as StepFailed and goes on up.

    :param fatal: whether the exception's handler reports it once more.
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
