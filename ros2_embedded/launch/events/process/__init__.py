# SPDX-License-Identifier: Apache-2.0
"""Events of processes: what happens in them, and what is asked of them."""
from __future__ import annotations

import signal as signal_module
from typing import Any, Callable, Dict, List, Optional, TYPE_CHECKING, Union

from ..._aliases import alias_submodules
from ..._base import Event
from ...utilities import ensure_argument_type

if TYPE_CHECKING:
    from ...actions import ExecuteProcess

__all__ = [
    'matches_executable', 'matches_name', 'matches_pid', 'ProcessExited', 'ProcessIO',
    'ProcessStarted', 'ProcessStderr', 'ProcessStdin', 'ProcessStdout', 'ProcessTargetedEvent',
    'RunningProcessEvent', 'ShutdownProcess', 'SignalProcess']


class RunningProcessEvent(Event):
    """Something happened to a process; its name is unique in the launch."""

    name = 'launch.events.process.RunningProcessEvent'

    def __init__(
        self, *, action: ExecuteProcess, name: str, cmd: List[str], cwd: Optional[str],
        env: Optional[Dict[str, str]], pid: int
    ) -> None:
        super().__init__()
        self.action = self.execute_process_action = action
        self.process_name = name
        self.cmd = cmd
        self.cwd = cwd
        self.env = env
        self.pid = pid


class ProcessStarted(RunningProcessEvent):
    name = 'launch.events.process.ProcessStarted'


class ProcessExited(RunningProcessEvent):
    """A process has ended; a negative return code is the signal that ended it."""

    name = 'launch.events.process.ProcessExited'

    def __init__(self, *, returncode: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.returncode = returncode


class ProcessIO(RunningProcessEvent):
    """Bytes came from, or go to, a process; not necessarily whole lines."""

    name = 'launch.events.process.ProcessIO'

    def __init__(self, *, text: bytes, fd: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.text = text
        self.from_stdin, self.from_stdout, self.from_stderr = fd == 0, fd == 1, fd == 2


class ProcessStdin(ProcessIO):
    name = 'launch.events.process.ProcessStdin'

    def __init__(self, *, text: bytes, **kwargs: Any) -> None:
        super().__init__(text=text, fd=0, **kwargs)


class ProcessStdout(ProcessIO):
    name = 'launch.events.process.ProcessStdout'

    def __init__(self, *, text: bytes, **kwargs: Any) -> None:
        super().__init__(text=text, fd=1, **kwargs)


class ProcessStderr(ProcessIO):
    name = 'launch.events.process.ProcessStderr'

    def __init__(self, *, text: bytes, **kwargs: Any) -> None:
        super().__init__(text=text, fd=2, **kwargs)


Matcher = Callable[[Any], bool]


class ProcessTargetedEvent(Event):
    """Something is asked of the processes whose actions match."""

    name = 'launch.events.process.ProcessTargetedEvent'

    def __init__(self, *, process_matcher: Matcher) -> None:
        super().__init__()
        self.process_matcher = process_matcher


class ShutdownProcess(ProcessTargetedEvent):
    """Processes are to end: SIGINT, then as long as need be SIGTERM and SIGKILL."""

    name = 'launch.events.process.ShutdownProcess'


class SignalProcess(ProcessTargetedEvent):
    name = 'launch.events.process.SignalProcess'

    def __init__(
        self, *, signal_number: Union[str, signal_module.Signals], process_matcher: Matcher
    ) -> None:
        super().__init__(process_matcher=process_matcher)
        ensure_argument_type(
            signal_number, (str, signal_module.Signals), 'signal_number', 'SignalProcess')
        self.signal = signal_number
        self.signal_name = signal_number if isinstance(signal_number, str) else signal_number.name


def _matches(check: Callable[[Dict[str, Any]], bool]) -> Matcher:
    return lambda action: action.process_details is not None and check(action.process_details)


def matches_pid(pid: int) -> Matcher:
    return _matches(lambda details: details['pid'] == pid)


def matches_name(name: str) -> Matcher:
    return _matches(lambda details: details['name'] == name)


def matches_executable(executable: str) -> Matcher:
    return _matches(lambda details: details['cmd'][0].endswith(executable))


alias_submodules(__name__, __all__, process_matchers=(
    'matches_executable', 'matches_name', 'matches_pid'))
