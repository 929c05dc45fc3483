# SPDX-License-Identifier: Apache-2.0
"""
Show the steps of a deployment: a line each at its end.

A terminal also shows the running time of the current steps. Elsewhere there is a line when a step
starts, and one every 30 seconds while it runs.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import queue
import shutil
import threading
import time
from typing import Optional, TextIO, Union

import launch.logging

from fogros2 import waiting
from fogros2.report import (
    ClockMeasured,
    Event,
    Progress,
    redraws,
    Silence,
    size,
    StepDone,
    StepFailed,
    StepStarted,
    Warned,
)
from fogros2.untrusted import clean
from fogros2.waiting import Periodic

_WIDTH = 24
#: Seconds of a step without a line, if there is no terminal.
STILL = 30.0
#: Seconds between two looks at the clock.
TICK = 1.0
#: Number of texts that wait for a screen that is not read; further ones are dropped.
_LONGEST = 10_000


class Screen:
    """
    A text stream that neither blocks nor fails: a closed terminal or a full pipe ends no launch.

    :param stream: where a thread writes the text.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.closed = False
        self._texts: queue.Queue[Union[str, threading.Event]] = queue.Queue(_LONGEST)
        threading.Thread(target=self._write_all, name='fog-screen', daemon=True).start()

    def write(self, text: str) -> int:
        """Write a text soon."""
        with contextlib.suppress(queue.Full):
            self._texts.put_nowait(text)
        return len(text)

    def flush(self) -> None:
        """Do nothing, because the thread flushes."""

    def isatty(self) -> bool:
        """Return whether the stream is a terminal."""
        return not self.stream.closed and self.stream.isatty()

    def drain(self) -> bool:
        """Return whether all texts are written, at the latest after a second."""
        written = threading.Event()
        with contextlib.suppress(queue.Full):
            self._texts.put_nowait(written)
            return written.wait(1.0) and not self.closed
        return False

    def _write_all(self) -> None:
        while True:
            text = self._texts.get()
            if isinstance(text, threading.Event):
                text.set()
            elif not self.closed:
                try:
                    self._write(text)
                except (OSError, ValueError):
                    self.closed = True

    def _write(self, text: str) -> None:
        try:
            handle = self.stream.fileno()
        except OSError:  # it has no file, such as a test's
            self.stream.write(text)
            return
        # a buffer whose lock this thread holds would end the interpreter with a fatal error
        data = text.encode(self.stream.encoding, 'backslashreplace')
        while data:
            data = data[os.write(handle, data):]


class Console:
    """
    Receive events from any thread and show them through launch's logger ``fogros2``.

    All that this logger shows is cleaned of control characters.
    Until ``close``, all lines of launch go through a :class:`Screen`.

    :param stream: replaces the stream of launch's screen handler.
    """

    def __init__(self, stream: Optional[TextIO] = None) -> None:
        self._logger = launch.logging.get_logger('fogros2')
        self._logger.addFilter(_cleaned)
        self._handler = launch.logging.launch_config.get_screen_handler()
        self._stream = Screen(stream or self._handler.stream)
        self._handler.stream = self._stream  # setStream fails where the former one is closed
        self._lock = threading.RLock()
        self._running: dict[tuple[str, str], _Running] = {}
        self._drawn = self._live = False
        with contextlib.suppress(ValueError):  # it is closed
            self._live = redraws(self._stream.stream)
        self._ticks = Periodic('fog-progress', TICK, self._tick)
        if self._live:
            # a log line overwrites the progress line instead of following it
            self._handler.addFilter(self._before_line)

    def __call__(self, event: Event) -> None:
        """Show an event."""
        with self._lock:
            if isinstance(event, StepStarted):
                # the step runs in the thread that reports it
                self._running[event.machine, event.step] = _Running(threading.get_ident())
                self._logger.log(logging.DEBUG if self._live else logging.INFO,
                                 f'{_where(event.machine)}: {event.step} ...')
            elif isinstance(event, StepDone):
                self._running.pop((event.machine, event.step), None)
                detail = f' ({event.detail})' if event.detail else ''
                self._logger.info(
                    f'{_where(event.machine)}: {event.step} {event.seconds:.2f} s{detail}')
            elif isinstance(event, StepFailed):
                self._running.pop((event.machine, event.step), None)
                what = f'{_where(event.machine)}: {event.step} failed after {event.seconds:.2f} s'
                if event.fatal:
                    # the launch ends with the reason: report the error once
                    self._logger.info(what)
                else:
                    self._logger.warning(f'{what}: {event.reason}')
            elif isinstance(event, Progress):
                running = self._running.setdefault(
                    (event.machine, event.step), _Running(threading.get_ident()))
                running.progress = event
            elif isinstance(event, ClockMeasured) and event.warn:
                what = (f"the clock of '{event.machine}' is {event.offset}, so TF look-ups and "
                        'stamp matching between the two fail')
                self._logger.warning(
                    f'{what}\nsynchronise both clocks: sudo apt-get install chrony')
            elif isinstance(event, Warned):
                self._logger.warning(f'{event.text}\n{event.remedy}')
            elif isinstance(event, Silence) and event.over:
                self._logger.info(
                    f'{event.machine}: answers again, after {event.seconds:.0f} s')
            elif isinstance(event, Silence):
                self._logger.warning(f'{event.machine}: no answer for {event.seconds:.0f} s '
                                     '(VPN); nodes keep running')
            self._draw()

    def close(self) -> None:
        """Remove the progress line."""
        self._ticks.close()
        with self._lock:
            self._running.clear()
            self._erase()
            self._handler.removeFilter(self._before_line)
            if self._stream.drain():
                self._handler.setStream(self._stream.stream)

    def _tick(self) -> None:
        with self._lock:
            if self._live:
                self._draw()
                return
            for (machine, step), running in self._running.items():
                if running.seconds >= running.told + STILL:
                    running.told = running.seconds // STILL * STILL
                    doing = [running.doing] if running.doing else []
                    if running.progress is not None:
                        doing.append(_bytes(running.progress))
                    self._logger.info(
                        f'{_where(machine)}: {step}: still working after {running.told:.0f} s'
                        + f" ({', '.join(doing)})" * bool(doing))

    def _before_line(self, record: logging.LogRecord) -> bool:
        with self._lock:
            self._erase()
        return True

    def _erase(self) -> None:
        if self._drawn:
            self._stream.write('\r\x1b[K')
            self._drawn = False

    def _draw(self) -> None:
        if not self._live or not self._logger.isEnabledFor(logging.INFO):
            return
        self._erase()
        if self._running:
            parts = [
                f'{_where(machine)}: {step}{running.bar}'
                + f' {running.seconds:.0f} s' * (running.seconds >= 1.0)
                for (machine, step), running in self._running.items()]
            if len(parts) == 1:
                (only,) = self._running.values()
                parts[0] += f' ({only.doing})' * bool(only.seconds >= STILL and only.doing)
            self._stream.write('   '.join(parts)[:shutil.get_terminal_size().columns - 1])
            self._drawn = True


def _cleaned(record: logging.LogRecord) -> bool:
    """Clean what this logger says: details, reasons and names may come from machines."""
    record.msg, record.args = clean(record.getMessage()), ()
    return True


@dataclasses.dataclass
class _Running:
    """A step that runs: its thread, its progress, and the seconds of its last line."""

    thread: int
    progress: Optional[Progress] = None
    told: float = 0.0
    begin: float = dataclasses.field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.begin

    @property
    def doing(self) -> str:
        return waiting.doing(self.thread)

    @property
    def bar(self) -> str:
        return '' if self.progress is None else _bar(self.progress)


def _where(machine: str) -> str:
    return machine or 'robot'


def _bar(progress: Progress) -> str:
    if not progress.total:
        return f' {_bytes(progress)}'
    full = min(_WIDTH, _WIDTH * progress.done // progress.total)
    return f" [{'#' * full}{'.' * (_WIDTH - full)}] {_bytes(progress)}"


def _bytes(progress: Progress) -> str:
    of = f' of {size(progress.total)}' if progress.total else ''
    return size(progress.done) + of
