# SPDX-License-Identifier: Apache-2.0
"""
Write a launch's steps and clock offsets to a file in its folder, for other programs to show.

The file has one JSON line per event. It is deleted with the folder when the launch ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import threading
import time
from typing import Any, Optional

from fogros2.clock import ClockOffset
from fogros2.report import (
    ClockMeasured,
    Event,
    Progress,
    Reporter,
    StepDone,
    StepFailed,
    StepStarted,
)

#: The file's name in the launch's folder.
FILE = 'steps.jsonl'
#: Minimum interval in seconds between two progress lines of a step.
PROGRESS_INTERVAL = 0.25
#: Steps from which on a step that repeats, such as a repair, drops its first one.
MOST = 200
_KINDS = {StepStarted: 'started', StepDone: 'done', StepFailed: 'failed', Progress: 'progress',
          ClockMeasured: 'clock'}


class Journal:
    """
    A Reporter that passes events on and writes them to a file; thread-safe.

    It drops a line that cannot be written (full disk, folder deleted at the end): the display of
    a launch must not stop the launch.

    :param report: receives each event.
    :param folder: the launch's folder; events before it exists are only passed on.
    """

    def __init__(
        self, report: Reporter, folder: Path, clock: Callable[[], float] = time.time,
    ) -> None:
        self._report = report
        self._folder = folder
        self._clock = clock
        self._lock = threading.Lock()
        self._told: dict[tuple[str, str], float] = {}

    def __call__(self, event: Event) -> None:
        """Pass an event on, and write it to the file."""
        try:
            self._report(event)
        finally:
            self._write(event)

    def _write(self, event: Event) -> None:
        now = self._clock()
        with self._lock:
            line = self._line(event, now)
            if line is None:
                return
            with contextlib.suppress(OSError), open(
                    self._folder / FILE, 'a', encoding='utf-8',
                    opener=lambda path, flags: os.open(path, flags, 0o600)) as file:
                file.write(line)

    def _line(self, event: Event, now: float) -> Optional[str]:
        kind = _KINDS.get(type(event))
        if kind is None:
            return None
        if isinstance(event, Progress):
            key = (event.machine, event.step)
            if now - self._told.get(key, 0.0) < PROGRESS_INTERVAL and event.done < event.total:
                return None
            self._told[key] = now
        fields = dataclasses.asdict(event)
        fields |= fields.pop('offset', {})
        if isinstance(event, StepFailed):
            fields['detail'] = fields.pop('reason')
        return json.dumps({'time': round(now, 3), 'event': kind, **fields}) + '\n'


@dataclasses.dataclass(frozen=True)
class Step:
    """
    The state of a step.

    :param machine: '' for the robot.
    :param begin: in seconds since the epoch.
    :param state: 'running', 'done' or 'failed'.
    :param seconds: its duration, None while it runs.
    :param detail: a few words; for a failed step the reason.
    :param done: bytes of ``total``; both 0 if unknown.
    :param fatal: False if it failed and the launch goes on without it.
    """

    machine: str
    step: str
    begin: float
    state: str = 'running'
    seconds: Optional[float] = None
    detail: str = ''
    done: int = 0
    total: int = 0
    fatal: bool = True


class Contents:
    """
    The contents of a journal, which grow by its lines; damaged lines are ignored.

    :ivar steps: in the order in which they began; see ``MOST``.
    :ivar clocks: the last offset of each machine's clock.
    """

    def __init__(self, lines: Iterable[str] = ()) -> None:
        self.steps: list[Step] = []
        self.clocks: dict[str, ClockOffset] = {}
        for line in lines:
            self.add(line)

    def add(self, line: str) -> None:
        """Add the next line."""
        with contextlib.suppress(ValueError, TypeError, KeyError, RecursionError):
            event = json.loads(line)
            if event['event'] == 'clock':
                self.clocks[str(event['machine'])] = ClockOffset(
                    float(event['seconds']), float(event['uncertainty']))
            else:
                self._add_step(event)

    def _begin(self, step: Step) -> None:
        if len(self.steps) >= MOST:
            first = next((i for i, entry in enumerate(self.steps) if entry.state != 'running'
                          and (entry.machine, entry.step) == (step.machine, step.step)), None)
            if first is not None:
                del self.steps[first]
        self.steps.append(step)

    def _add_step(self, event: dict[str, Any]) -> None:
        entries = self.steps
        machine, name = str(event['machine']), str(event['step'])
        kind, at = event['event'], float(event['time'])
        if kind == 'started':
            self._begin(Step(machine, name, at))
            return
        index = next((i for i in reversed(range(len(entries))) if entries[i].state == 'running'
                      and (entries[i].machine, entries[i].step) == (machine, name)), None)
        if kind == 'progress':
            if index is not None:
                entries[index] = dataclasses.replace(
                    entries[index], done=int(event['done']), total=int(event['total']))
        elif kind in ('done', 'failed'):
            seconds = float(event['seconds'])
            if index is None:
                # a failed undo step is reported only at its end
                self._begin(Step(machine, name, at - seconds))
                index = len(entries) - 1
            entries[index] = dataclasses.replace(
                entries[index], state=kind, seconds=seconds, detail=str(event['detail']),
                fatal=bool(event.get('fatal', True)))


def read(folder: Path) -> Contents:
    """Return the contents of the journal of a launch's folder, empty without a journal."""
    try:
        return Contents((folder / FILE).read_text(errors='replace').splitlines())
    except OSError:
        return Contents()
