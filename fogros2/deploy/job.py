# SPDX-License-Identifier: Apache-2.0
"""What the steps of one machine's deployment share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
import contextlib
import dataclasses
import threading
from typing import Any, Optional, TYPE_CHECKING

from fogros2.errors import ConnectError, DeadlineExceeded, FogError
from fogros2.model import Command, MachineSpec
from fogros2.report import step
from fogros2.shell import Shell
from fogros2.store import MachineDirectory, Record

if TYPE_CHECKING:
    from fogros2.deploy.launch import Launch

#: Seconds in which a machine that is to be tidied up has to answer, and those that each further
#: part of it may take if it doesn't: a Ctrl-C shouldn't wait for a computer that is off.
ANSWER, HURRIED = 4.0, 2.0
#: Seconds that it may say nothing, having answered before, and one command may take then.
SILENT = 15.0


class Job:
    """
    One machine's deployment: its record, what was asked and decided, and the way back.

    :param spec: as the launch file has it; ``spec`` becomes the one with all choices made.
    """

    def __init__(self, launch: Launch, spec: MachineSpec) -> None:
        self.launch = launch
        self.spec = spec
        self.name = spec.name
        self.timeouts = launch.timeouts
        self.provider = launch.provider(spec.provider)
        self.folder: MachineDirectory = launch.store.machine(spec.name)
        self.record = Record(spec.name, spec.provider, spec, asked=spec.options)
        self.undo = contextlib.ExitStack()
        self.undo.callback(self._tell_left)
        self._left: list[str] = []
        #: Whether an earlier launch made the machine, and the id of the one that had it last.
        self.reused = False
        self.former = ''
        #: Until the machine is up.
        self.failed = True
        #: ``gone``: the provider reports the machine as stopped.
        #: ``deleted``: the provider no longer knows the machine.
        self.gone = self.deleted = False
        self.shell: Optional[Shell] = None
        #: Asks the machine's agent for a sign of life, within so many seconds.
        self.ask: Optional[Callable[[float], object]] = None
        self._hurried: Optional[bool] = None
        #: Set when the launch's is, or when a step failed: those beside it needn't go on.
        self.cancel = Either(launch.cancel)

    @contextlib.contextmanager
    def failing(self) -> Iterator[None]:
        """End what runs beside the block if that fails."""
        try:
            yield
        except BaseException:
            self.cancel.set()
            raise

    def step(self, name: str) -> contextlib.AbstractContextManager[list[str]]:
        """Report a step of this machine around a block; see :func:`fogros2.report.step`."""
        return step(self.launch.report, self.name, name)

    def undoing(self, name: str, undo: Callable[[], None]) -> None:
        """
        Push an undo step; its failure is reported, and the others run all the same.

        What stays on a machine that doesn't answer is reported once, in the end.
        """
        self.undo.callback(self.undone, name, undo)

    def undone(self, name: str, undo: Callable[[], None]) -> None:
        """Take an undo step now, in the same manner."""
        def tried() -> None:
            try:
                undo()
            except (ConnectError, DeadlineExceeded):
                if not self._hurried:
                    raise
                self._left.append(name)

        self.launch.attempt(self.name, name, tried)

    def _tell_left(self) -> None:
        """Say what is left on a machine that didn't answer, and how it ends."""
        def tell() -> None:
            if self.folder.exists():
                ends = 'ends the nodes'
                hint = f'the next launch may take the machine, or: ros2 fog delete {self.name}'
            else:
                ends, hint = 'ends all of that and leaves', 'nothing needs to be done'
            # one whose agent was about to start may have none
            agent = 'its agent' if self.ask is not None else 'its agent, if it has one by now,'
            raise ConnectError(
                f"'{self.name}' does not answer, so what it has of this launch stays there "
                f"({', '.join(dict.fromkeys(self._left))}): {agent} {ends} by itself, "
                f'{self.spec.robot_timeout:g} s after it last heard of the launch', hint)

        if self._left:
            self.launch.attempt(self.name, 'left there', tell)

    def save(self, **changes: Any) -> None:
        """Write changes of the record down."""
        # known here even where it can't be written down, as the way down needs it
        self.record = dataclasses.replace(self.record, **changes)
        self.folder.save(self.record)

    @property
    def machine_id(self) -> str:
        """The provider's id of the machine; there is one as soon as it was asked for."""
        assert self.record.machine_id is not None
        return self.record.machine_id

    @property
    def survives(self) -> bool:
        """Whether the computer stays when the launch ends, so that it has to be tidied up."""
        if self.gone:
            return False
        if self.failed and not self.reused:
            return not self.provider.owned
        return self.spec.on_exit == 'keep' or not self.provider.owned

    def on(self, shell: Shell, commands: Iterable[Command]) -> str:
        """Run commands on the machine on the way up; return what the last one printed."""
        output = ''
        for command in commands:
            output = shell.run(
                command, timeout=self.timeouts.vpn, cancel=self.cancel).stdout
        return output

    def tidy(self, shell: Shell, commands: Iterable[Command]) -> None:
        """Run commands on the machine on the way down."""
        for command in commands:
            try:
                shell.run(command, timeout=self.patience(min(self.timeouts.vpn, SILENT)))
            except (ConnectError, DeadlineExceeded):
                self.hurry()
                raise

    def hurry(self) -> None:
        """Shorten the time-outs of the remaining undo steps: the machine doesn't answer."""
        self._hurried = True

    def patience(self, seconds: float) -> float:
        """
        Return how long a part of the way down may take that needs the machine.

        :param seconds: what it may take of a machine that answers; the first to ask finds out.
        """
        if self._hurried is None:
            self._hurried = not self._answers()
        return min(seconds, HURRIED) if self._hurried else seconds

    def _answers(self) -> bool:
        try:
            if self.ask is not None:
                self.ask(ANSWER)
                return True
        except DeadlineExceeded:
            return False
        except FogError:
            pass  # the agent has gone, the machine may be there
        try:
            if self.shell is not None:
                self.shell.run(
                    Command(('true',), what='reach it'), timeout=ANSWER, check=False)
                return True
        except (ConnectError, DeadlineExceeded):
            pass
        return False


class Either(threading.Event):
    """An event that counts as set when another one is set, too."""

    def __init__(self, other: threading.Event) -> None:
        super().__init__()
        self._other = other

    def is_set(self) -> bool:
        """Return whether one of the two is set."""
        return super().is_set() or self._other.is_set()

    def wait(self, timeout: Optional[float] = None) -> bool:
        """Wait for the other one, a Ctrl-C; that this one was set is seen after ``timeout``."""
        return self._other.wait(timeout) or self.is_set()
