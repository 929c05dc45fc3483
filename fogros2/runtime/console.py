# SPDX-License-Identifier: Apache-2.0
"""Show the steps of a deployment in the terminal: one line each."""

from __future__ import annotations

import logging
import shutil
import sys
import threading
from typing import Optional, TextIO

import launch.logging

from fogros2.report import (
    ClockMeasured,
    Event,
    Progress,
    Silence,
    size,
    StepDone,
    StepFailed,
    StepStarted,
    Warned,
)
from fogros2.untrusted import clean

_WIDTH = 24


class Console:
    """
    Receive events from any thread and show them through launch's logger ``fogros2``.

    All that this logger shows is cleaned of control characters.

    :param stream: shows the progress line, if it is a terminal.
    """

    def __init__(self, stream: Optional[TextIO] = None) -> None:
        self._logger = launch.logging.get_logger('fogros2')
        self._logger.addFilter(_cleaned)
        self._stream = stream or sys.stdout
        self._lock = threading.RLock()
        self._running: dict[tuple[str, str], str] = {}
        self._drawn = False
        self._live = self._stream.isatty()
        if self._live:
            # a log line overwrites the progress line instead of following it
            launch.logging.launch_config.get_screen_handler().addFilter(self._before_line)

    def __call__(self, event: Event) -> None:
        """Show an event."""
        with self._lock:
            if isinstance(event, StepStarted):
                self._running[event.machine, event.step] = ''
                self._logger.debug(f'{_where(event.machine)}: {event.step} ...')
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
                self._running[event.machine, event.step] = _bar(event)
            elif isinstance(event, ClockMeasured) and event.warn:
                what = (f"the clock of '{event.machine}' is {event.offset}, so TF look-ups and "
                        'stamp matching between the two fail')
                self._logger.warning(
                    f'{what}\nsynchronise both clocks: sudo apt-get install chrony')
            elif isinstance(event, Warned):
                self._logger.warning(f'{event.text}\n{event.remedy}')
            elif isinstance(event, Silence) and event.seconds:
                self._logger.warning(f'{event.machine}: no answer for {event.seconds:.0f} s '
                                     '(VPN); nodes keep running')
            elif isinstance(event, Silence):
                self._logger.info(f'{event.machine}: answers again')
            self._draw()

    def close(self) -> None:
        """Remove the progress line."""
        with self._lock:
            self._running.clear()
            self._erase()
            if self._live:
                launch.logging.launch_config.get_screen_handler().removeFilter(
                    self._before_line)

    def _before_line(self, record: logging.LogRecord) -> bool:
        with self._lock:
            self._erase()
        return True

    def _erase(self) -> None:
        if self._drawn:
            self._stream.write('\r\x1b[K')
            self._stream.flush()
            self._drawn = False

    def _draw(self) -> None:
        if not self._live or not self._logger.isEnabledFor(logging.INFO):
            return
        self._erase()
        if self._running:
            parts = [
                f'{_where(machine)}: {step}{bar}'
                for (machine, step), bar in self._running.items()]
            self._stream.write('   '.join(parts)[:shutil.get_terminal_size().columns - 1])
            self._stream.flush()
            self._drawn = True


def _cleaned(record: logging.LogRecord) -> bool:
    """Clean what this logger says: details, reasons and names may come from machines."""
    record.msg, record.args = clean(record.getMessage()), ()
    return True


def _where(machine: str) -> str:
    return machine or 'robot'


def _bar(progress: Progress) -> str:
    done = size(progress.done)
    if not progress.total:
        return f' {done}'
    full = min(_WIDTH, _WIDTH * progress.done // progress.total)
    return f" [{'#' * full}{'.' * (_WIDTH - full)}] {done} of {size(progress.total)}"
