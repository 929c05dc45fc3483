# SPDX-License-Identifier: Apache-2.0
"""Events of processes: what happens in them, and requests to them."""
from __future__ import annotations

import functools
import signal as signal_module
from typing import Any, Callable

from ..._base import Action, Event
from ...utilities import ensure_argument_type

Matcher = Callable[[Any], bool]


class ProcessAction(Action):
    """What events need of ExecuteLocal, which handles them."""

    process_details: Any


# Errors name the class that users know.
ProcessAction.__name__ = 'ExecuteLocal'


class RunningProcessEvent(Event):
    """Something happened to a process; its name is unique in the launch."""

    def __init__(
        self, *, action: ProcessAction, name: str, cmd: list[str], cwd: str | None,
        env: dict[str, str] | None, pid: int
    ) -> None:
        self.action = self.execute_process_action = action
        self.process_name = name
        self.cmd = cmd
        self.cwd = cwd
        self.env = env
        self.pid = pid


class ProcessStarted(RunningProcessEvent):
    pass


class ProcessExited(RunningProcessEvent):
    """A process has ended; a negative return code is the signal that ended it."""

    def __init__(self, *, returncode: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.returncode = returncode


class ProcessIO(RunningProcessEvent):
    """Bytes came from, or go to, a process; not necessarily whole lines."""

    def __init__(self, *, text: bytes, fd: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.text = text
        self.from_stdin, self.from_stdout, self.from_stderr = fd == 0, fd == 1, fd == 2


class ProcessStdin(ProcessIO):
    __init__ = functools.partialmethod(ProcessIO.__init__, fd=0)


class ProcessStdout(ProcessIO):
    __init__ = functools.partialmethod(ProcessIO.__init__, fd=1)


class ProcessStderr(ProcessIO):
    __init__ = functools.partialmethod(ProcessIO.__init__, fd=2)


class ProcessTargetedEvent(Event):
    """Something is asked of the processes whose actions match."""

    def __init__(self, *, process_matcher: Matcher) -> None:
        self.process_matcher = process_matcher


class ShutdownProcess(ProcessTargetedEvent):
    """Processes are to end: SIGINT, then as long as need be SIGTERM and SIGKILL."""


class SignalProcess(ProcessTargetedEvent):

    def __init__(
        self, *, signal_number: str | signal_module.Signals, process_matcher: Matcher
    ) -> None:
        super().__init__(process_matcher=process_matcher)
        ensure_argument_type(
            signal_number, (str, signal_module.Signals), 'signal_number', 'SignalProcess')
        self.signal = signal_number
        self.signal_name = signal_number if isinstance(signal_number, str) else signal_number.name


def _matches(check: Callable[[dict[str, Any]], bool]) -> Matcher:
    return lambda action: action.process_details is not None and check(action.process_details)


def matches_pid(pid: int) -> Matcher:
    return _matches(lambda details: details['pid'] == pid)


def matches_name(name: str) -> Matcher:
    return _matches(lambda details: details['name'] == name)


def matches_executable(executable: str) -> Matcher:
    return _matches(lambda details: details['cmd'][0].endswith(executable))
