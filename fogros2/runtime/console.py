# SPDX-License-Identifier: Apache-2.0
"""Show the steps of a deployment in the terminal: one line each."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import shutil
import threading
from typing import Optional, TextIO, Union

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
        return self.stream.isatty()

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
        self._handler.setStream(self._stream)
        self._lock = threading.RLock()
        self._running: dict[tuple[str, str], str] = {}
        self._drawn = False
        self._live = self._stream.isatty()
        if self._live:
            # a log line overwrites the progress line instead of following it
            self._handler.addFilter(self._before_line)

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
            elif isinstance(event, Silence) and event.over:
                self._logger.info(
                    f'{event.machine}: answers again, after {event.seconds:.0f} s')
            elif isinstance(event, Silence):
                self._logger.warning(f'{event.machine}: no answer for {event.seconds:.0f} s '
                                     '(VPN); nodes keep running')
            self._draw()

    def close(self) -> None:
        """Remove the progress line."""
        with self._lock:
            self._running.clear()
            self._erase()
            self._handler.removeFilter(self._before_line)
            if self._stream.drain():
                self._handler.setStream(self._stream.stream)

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
                f'{_where(machine)}: {step}{bar}'
                for (machine, step), bar in self._running.items()]
            self._stream.write('   '.join(parts)[:shutil.get_terminal_size().columns - 1])
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
