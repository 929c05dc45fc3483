# SPDX-License-Identifier: Apache-2.0
"""The state that the steps of one machine's deployment share."""

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

#: Seconds in which a machine has to answer on the way down, and the time-out of each further
#: undo step if the machine does not: Ctrl-C must not wait long for a computer that is off.
ANSWER, HURRIED = 4.0, 2.0
#: Seconds without a sign of life that the way down accepts; time-out of one of its commands.
SILENT = 15.0


class Job:
    """
    One machine's deployment: spec, record, shell, undo stack, cancel event.

    :param spec: the launch file's spec; later steps replace it by one with all choices made.
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
        #: Whether an earlier launch created the machine, and the id of its last launch.
        self.reused = False
        self.former = ''
        #: False as soon as the machine is up.
        self.failed = True
        #: ``gone``: the provider reports the machine as stopped.
        #: ``deleted``: the provider no longer knows the machine.
        self.gone = self.deleted = False
        self.shell: Optional[Shell] = None
        #: Ping the machine's agent; the argument is the time-out in seconds.
        self.ask: Optional[Callable[[float], object]] = None
        self._hurried: Optional[bool] = None
        #: Set when the launch is cancelled, or when a step fails: parallel steps then end.
        self.cancel = Either(launch.cancel)

    @contextlib.contextmanager
    def failing(self) -> Iterator[None]:
        """Cancel the parallel steps if the block fails."""
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
        Push an undo step; if it fails, report the error, and run the other undo steps.

        Steps that fail because the machine does not answer are reported together, at the end.
        """
        self.undo.callback(self.undone, name, undo)

    def undone(self, name: str, undo: Callable[[], None]) -> None:
        """Run an undo step now, with the error handling of :meth:`undoing`."""
        def tried() -> None:
            try:
                undo()
            except (ConnectError, DeadlineExceeded):
                if not self._hurried:
                    raise
                self._left.append(name)

        self.launch.attempt(self.name, name, tried)

    def _tell_left(self) -> None:
        """Report what stays on a machine that did not answer, and how the machine ends."""
        def tell() -> None:
            if self.folder.exists():
                ends = 'ends the nodes'
                hint = f'the next launch may take the machine, or: ros2 fog delete {self.name}'
            else:
                ends, hint = 'ends all of that and leaves', 'nothing needs to be done'
            # the agent may not have started yet
            agent = 'its agent' if self.ask is not None else 'its agent, if it has one by now,'
            raise ConnectError(
                f"'{self.name}' does not answer, so what it has of this launch stays there "
                f"({', '.join(dict.fromkeys(self._left))}): {agent} {ends} by itself, "
                f'{self.spec.robot_timeout:g} s after it last heard of the launch', hint)

        if self._left:
            self.launch.attempt(self.name, 'left there', tell)

    def save(self, **changes: Any) -> None:
        """Change fields of the record and write it to disk."""
        # the way down needs the changes even if they cannot be written
        self.record = dataclasses.replace(self.record, **changes)
        self.folder.save(self.record)

    @property
    def machine_id(self) -> str:
        """The provider's id of the machine; set as soon as the provider has created it."""
        assert self.record.machine_id is not None
        return self.record.machine_id

    @property
    def survives(self) -> bool:
        """Whether the machine outlives the launch, so that the launch has to clean it up."""
        if self.gone:
            return False
        if self.failed and not self.reused:
            return not self.provider.owned
        return self.spec.on_exit == 'keep' or not self.provider.owned

    def on(self, shell: Shell, commands: Iterable[Command]) -> str:
        """Run commands on the machine on the way up; return the last one's output."""
        output = ''
        for command in commands:
            output = shell.run(
                command, timeout=self.timeouts.vpn, cancel=self.cancel).stdout
        return output

    def tidy(self, shell: Shell, commands: Iterable[Command]) -> None:
        """Run commands on the machine on the way down; each of them may run twice."""
        for command in commands:
            seconds = self.patience(min(self.timeouts.vpn, SILENT))
            try:
                try:
                    shell.run(command, timeout=seconds)
                except ConnectError:
                    # the connection may break though the machine is there
                    if not self._answers():
                        raise
                    shell.run(command, timeout=seconds)
            except (ConnectError, DeadlineExceeded):
                self.hurry()
                raise

    def hurry(self) -> None:
        """Shorten the time-outs of the remaining undo steps: the machine does not answer."""
        self._hurried = True

    def patience(self, seconds: float) -> float:
        """
        Return the time-out in seconds of an undo step that needs the machine.

        :param seconds: the time-out if the machine answers; the first call checks whether it does.
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
            pass  # the agent has ended; the machine may still be there
        try:
            if self.shell is not None:
                self.shell.run(
                    Command(('true',), what='reach it'), timeout=ANSWER, check=False)
                return True
        except (ConnectError, DeadlineExceeded):
            pass
        return False


class Either(threading.Event):
    """An event that also counts as set when another event is set."""

    def __init__(self, other: threading.Event) -> None:
        super().__init__()
        self._other = other

    def is_set(self) -> bool:
        """Return whether one of the two events is set."""
        return super().is_set() or self._other.is_set()

    def wait(self, timeout: Optional[float] = None) -> bool:
        """Wait for the other event; notice this event only after ``timeout`` seconds."""
        return self._other.wait(timeout) or self.is_set()
