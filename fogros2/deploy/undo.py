# SPDX-License-Identifier: Apache-2.0
"""Undo steps of a launch and of its machines; one that fails does not stop the others."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import time

from fogros2.errors import FogError
from fogros2.report import Reporter, StepFailed


class UndoStack(contextlib.ExitStack):
    """
    Undo steps, of which the last pushed one runs first.

    :param machine: name of the machine, '' for the robot.
    :param failures: receives the error of each step that fails; a launch and its machines share
        the list.
    """

    def __init__(self, report: Reporter, machine: str, failures: list[FogError]) -> None:
        super().__init__()
        self._report = report
        self._machine = machine
        self._failures = failures

    def add(self, name: str, undo: Callable[[], object]) -> None:
        """Push an undo step that is named in reports."""
        self.callback(self.run, name, undo)

    def run(self, name: str, undo: Callable[[], object]) -> None:
        """Run an undo step now; if it fails, report and remember the error."""
        begin = time.monotonic()
        try:
            undo()
        except FogError as error:
            self.failed(name, error, time.monotonic() - begin)

    def failed(self, name: str, error: FogError, seconds: float = 0.0) -> None:
        """Report and remember the error of an undo step."""
        self._report(StepFailed(self._machine, name, seconds, str(error)))
        self._failures.append(error)
