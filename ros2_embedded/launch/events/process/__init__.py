# SPDX-License-Identifier: Apache-2.0
"""Events of processes: what happens in them, and what is asked of them."""
from __future__ import annotations

import signal as signal_module
from typing import Any, Callable, Dict, List, Optional, TYPE_CHECKING, Union

from ..._aliases import alias_submodules
from ...event import Event
from ...utilities import ensure_argument_type

if TYPE_CHECKING:
    from ...actions import ExecuteLocal, ExecuteProcess

__all__ = [
    'matches_executable',
    'matches_name',
    'matches_pid',
    'ProcessExited',
    'ProcessIO',
    'ProcessStarted',
    'ProcessStderr',
    'ProcessStdin',
    'ProcessStdout',
    'ProcessTargetedEvent',
    'RunningProcessEvent',
    'ShutdownProcess',
    'SignalProcess',
]


class RunningProcessEvent(Event):
    """
    Something happened to a process.

    :param action: the action that started it.
    :param name: unique among the launch's processes.
    """

    name = 'launch.events.process.RunningProcessEvent'

    def __init__(
        self, *, action: ExecuteProcess, name: str, cmd: List[str], cwd: Optional[str],
        env: Optional[Dict[str, str]], pid: int
    ) -> None:
        super().__init__()
        self.__action = action
        self.__name = name
        self.__cmd = cmd
        self.__cwd = cwd
        self.__env = env
        self.__pid = pid

    @property
    def action(self) -> ExecuteProcess:
        """The action that started the process."""
        return self.__action

    @property
    def execute_process_action(self) -> ExecuteProcess:
        """The action that started the process."""
        return self.__action

    @property
    def process_name(self) -> str:
        """The process's name, unique in this launch."""
        return self.__name

    @property
    def cmd(self) -> List[str]:
        """The command."""
        return self.__cmd

    @property
    def cwd(self) -> Optional[str]:
        """The working directory, None for the launch's."""
        return self.__cwd

    @property
    def env(self) -> Optional[Dict[str, str]]:
        """The whole environment."""
        return self.__env

    @property
    def pid(self) -> int:
        """The process id."""
        return self.__pid


class ProcessStarted(RunningProcessEvent):
    """A process has been started."""

    name = 'launch.events.process.ProcessStarted'


class ProcessExited(RunningProcessEvent):
    """A process has ended; a negative return code is the signal that ended it."""

    name = 'launch.events.process.ProcessExited'

    def __init__(self, *, returncode: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__returncode = returncode

    @property
    def returncode(self) -> int:
        """The exit status, or minus the signal."""
        return self.__returncode


class ProcessIO(RunningProcessEvent):
    """Bytes came from, or go to, a process; not necessarily whole lines."""

    name = 'launch.events.process.ProcessIO'

    def __init__(self, *, text: bytes, fd: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__text = text
        self.__fd = fd

    @property
    def text(self) -> bytes:
        """The bytes."""
        return self.__text

    @property
    def from_stdin(self) -> bool:
        """Whether it is standard input."""
        return self.__fd == 0

    @property
    def from_stdout(self) -> bool:
        """Whether it is standard output."""
        return self.__fd == 1

    @property
    def from_stderr(self) -> bool:
        """Whether it is standard error."""
        return self.__fd == 2


class ProcessStdin(ProcessIO):
    """Bytes for a process's standard input."""

    name = 'launch.events.process.ProcessStdin'

    def __init__(self, *, text: bytes, **kwargs: Any) -> None:
        super().__init__(text=text, fd=0, **kwargs)


class ProcessStdout(ProcessIO):
    """Bytes from a process's standard output."""

    name = 'launch.events.process.ProcessStdout'

    def __init__(self, *, text: bytes, **kwargs: Any) -> None:
        super().__init__(text=text, fd=1, **kwargs)


class ProcessStderr(ProcessIO):
    """Bytes from a process's standard error."""

    name = 'launch.events.process.ProcessStderr'

    def __init__(self, *, text: bytes, **kwargs: Any) -> None:
        super().__init__(text=text, fd=2, **kwargs)


Matcher = Callable[['ExecuteLocal'], bool]


class ProcessTargetedEvent(Event):
    """Something is asked of the processes whose actions match."""

    name = 'launch.events.process.ProcessTargetedEvent'

    def __init__(self, *, process_matcher: Matcher) -> None:
        super().__init__()
        self.__process_matcher = process_matcher

    @property
    def process_matcher(self) -> Matcher:
        """Says of an action whether its process is meant."""
        return self.__process_matcher


class ShutdownProcess(ProcessTargetedEvent):
    """Processes are to end: SIGINT, then as long as need be SIGTERM and SIGKILL."""

    name = 'launch.events.process.ShutdownProcess'


class SignalProcess(ProcessTargetedEvent):
    """Processes are to get a signal, given by name or number."""

    name = 'launch.events.process.SignalProcess'

    def __init__(
        self, *, signal_number: Union[str, signal_module.Signals], process_matcher: Matcher
    ) -> None:
        super().__init__(process_matcher=process_matcher)
        ensure_argument_type(
            signal_number, (str, signal_module.Signals), 'signal_number', 'SignalProcess')
        self.__signal = signal_number

    @property
    def signal(self) -> Union[str, signal_module.Signals]:
        """The signal as it was given."""
        return self.__signal

    @property
    def signal_name(self) -> str:
        """The signal's name, such as SIGINT."""
        return self.__signal if isinstance(self.__signal, str) else self.__signal.name


def _matches(check: Callable[[Dict[str, Any]], bool]) -> Matcher:
    return lambda action: action.process_details is not None and check(action.process_details)


def matches_pid(pid: int) -> Matcher:
    """Return a matcher for the action whose process has this id."""
    return _matches(lambda details: details['pid'] == pid)


def matches_name(name: str) -> Matcher:
    """Return a matcher for the action whose process has this name."""
    return _matches(lambda details: details['name'] == name)


def matches_executable(executable: str) -> Matcher:
    """Return a matcher for actions whose command's first word ends so."""
    return _matches(lambda details: details['cmd'][0].endswith(executable))


alias_submodules(__name__, __all__[3:], {
    'process_matchers': ('matches_executable', 'matches_name', 'matches_pid')})
