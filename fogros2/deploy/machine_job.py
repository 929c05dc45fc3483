# SPDX-License-Identifier: Apache-2.0
"""One machine's deployment: what its steps learn and change, and how they are undone."""

from __future__ import annotations

from collections.abc import Callable, Iterable
import contextlib
import dataclasses
import threading
import time
from typing import Any, Optional

from fogros2 import plan
from fogros2.agent.loop import boot_clock
from fogros2.agent_client import AgentClient, Heartbeat
from fogros2.deploy.context import Context
from fogros2.deploy.life import Life, Phase
from fogros2.deploy.undo import PORTS, Site, UndoStack, unmake
from fogros2.errors import AgentAbsent, ConnectError, DeadlineExceeded, FogError
from fogros2.model import Command, MachineSpec, VpnInterface
from fogros2.provider import Capabilities, Provider
from fogros2.report import step
from fogros2.shell import Shell
from fogros2.store import Made, Record
from fogros2.waiting import Periodic

#: Seconds in which a machine has to answer on the way down, and the time-out of each further
#: undo step if the machine does not: Ctrl-C must not wait long for a computer that is off.
ANSWER_TIMEOUT, SHORT_TIMEOUT = 4.0, 2.0
#: Seconds without a sign of life that the way down accepts; time-out of one of its commands.
SILENCE_TIMEOUT = 15.0
#: Folder of the agents on machines whose provider chooses none.
AGENT_FOLDER = '/run/fogros2'


class MachineJob(Site):
    """
    One machine's deployment: the base of :class:`~.running.RunningMachine`.

    :param spec: the launch file's spec; the creation replaces it by one with all choices made.
    """

    #: Each is set by the step that creates it.
    shell: Shell
    agent: AgentClient
    interface: VpnInterface
    heartbeat: Heartbeat

    def __init__(self, context: Context, spec: MachineSpec) -> None:
        self._context = context
        self.spec = spec
        #: The lifetime that the launch asks for, in seconds.
        self._lifetime = spec.lifetime
        #: When the agent ends the machine, by ``boot_clock``.
        self.expires = 0.0
        self.name = spec.name
        self.record = Record(spec.name, spec.provider, spec, asked=spec.options)
        self._saving = threading.RLock()
        self.undo = UndoStack(context.report, spec.name, context.failures)
        self.undo.callback(self._report_left)
        self._left: list[str] = []
        self.life = Life()
        #: Whether the launch has deleted, stopped or left it as its ``on_exit`` says.
        self.has_ended = False
        #: Ids of earlier launches, oldest first; one of them has the machine's agent, if any.
        self.formers: tuple[str, ...] = ()
        #: When this launch created the machine or took it over, by ``time.monotonic``.
        self.claimed = time.monotonic()
        #: Seconds of silence after which it is lost, whatever its provider reports.
        self.longest_silence: Optional[float] = None
        #: Seconds for which it is not lost, if its provider reports nothing either.
        self.least_silence = 0.0
        #: Whether its agent has announced the end of the nodes: silence is no news then.
        self.announced = False
        #: The agent's UDP port for heartbeats, and the address from which they come.
        self.heartbeats = (plan.HEARTBEAT_PORT, context.vpn.interface.address)
        #: Number of the first agent event that belongs to this launch; 0 before the agent answers.
        self.first_event = 0
        #: Functions that ask the machine for an answer; each gets the time-out in seconds.
        self.probes: list[Callable[[float], object]] = []
        #: Whether the machine does not answer; None until an undo step needs it.
        self._out_of_reach: Optional[bool] = None
        #: Makes the agent wait again for heartbeats, until these come through the VPN.
        self.rearming: Optional[Periodic] = None
        #: What else may help if nothing comes back through the VPN.
        self.advice: list[str] = []
        #: Set when the launch is cancelled, or when a step fails: parallel steps then end.
        self.cancel = Either(context.cancel)
        #: Set when the undo steps of a machine that was up have begun.
        self.ending = threading.Event()

    def step(self, name: str) -> contextlib.AbstractContextManager[list[str]]:
        """Report a step of this machine around a block; see :func:`fogros2.report.step`."""
        return step(self._context.report, self.name, name)

    def limit(self, *, made: bool = False) -> None:
        """
        Let features limit the lifetime, from now on; see :meth:`fogros2.feature.Feature.lifetime`.

        :raises FogError: they allow none, or another machine does not answer.
        """
        self.spec = self._context.choices.limited(
            dataclasses.replace(self.spec, lifetime=self._lifetime), made=made)
        self._context.shorten_others()

    def restart_lifetime(self, seconds: float) -> None:
        """Note that the agent gets a lifetime which starts now."""
        self.spec = dataclasses.replace(self.spec, lifetime=seconds)
        self.expires = boot_clock() + seconds
        self.save(spec=self.spec, armed=time.time())

    @property
    def time_left(self) -> float:
        """Seconds until the agent ends the machine."""
        return self.expires - boot_clock()

    def push(self, kind: str, port: int = 0, **changes: Any) -> None:
        """Push the undo of what the next step makes, and record it with other changes."""
        self.may_make(kind, port)
        self.makes(kind, port, **changes)

    def may_make(self, kind: str, port: int = 0) -> None:
        """Push the undo of what may be recorded later."""
        self.undoing(kind, lambda: self._unmake(Made(kind, port)))

    def makes(self, kind: str, port: int = 0, **changes: Any) -> None:
        """Record what the launch makes, before it makes it."""
        made = Made(kind, port)
        with self._saving:
            self.save(made=(*(other for other in self.record.made if other != made), made),
                      **changes)

    def _unmake(self, made: Made) -> None:
        if made not in self.record.made:
            return
        if not self.survives(stopped=made.kind in PORTS) or not unmake(self, made):
            self.forget(made)

    def forget(self, made: Made) -> None:
        """Note, with the record's next change, that something is undone: an undo may run twice."""
        with self._saving:
            self.record = dataclasses.replace(self.record, made=tuple(
                other for other in self.record.made if other != made))

    def undoing(self, name: str, undo: Callable[[], None]) -> None:
        """
        Push an undo step; if it fails, report the error, and run the other undo steps.

        Steps that fail because the machine does not answer are reported together, at the end.
        """
        def tried() -> None:
            try:
                undo()
            except (ConnectError, DeadlineExceeded):
                if not self._out_of_reach:
                    raise
                self._left.append(name)

        self.undo.add(name, tried)

    def _report_left(self) -> None:
        """Report what stays on a machine that did not answer, and how the machine ends."""
        def left() -> None:
            if self._context.store.exists(self.name):
                ends = 'ends the nodes'
                hint = f'the next launch may take the machine, or: ros2 fog delete {self.name}'
            else:
                ends, hint = 'ends all of that and leaves', 'nothing needs to be done'
            # the agent may not have started yet
            agent = 'its agent' if self.first_event else 'its agent, if it has one by now,'
            raise ConnectError(
                f"'{self.name}' does not answer, so parts of this launch stay there "
                f"({', '.join(dict.fromkeys(self._left))}): {agent} {ends} by itself, "
                f'{self.spec.robot_timeout:g} s after the last heartbeat of the launch', hint)

        if self._left:
            self.undo.run('left there', left)

    def save(self, **changes: Any) -> None:
        """Change fields of the record and write it to disk."""
        with self._saving:
            # the way down needs the changes even if they cannot be written
            self.record = dataclasses.replace(self.record, **changes)
            self._context.store.save(self.record)

    @property
    def provider(self) -> Provider:
        """The machine's provider."""
        return self._context.provider

    @property
    def launch(self) -> str:
        """The launch's id."""
        return self._context.launch_id

    @property
    def rmw(self) -> str:
        """The launch's middleware."""
        return self._context.dds.rmw

    @property
    def machine_id(self) -> str:
        """The provider's id of the machine; set as soon as the provider has created it."""
        assert self.record.machine_id is not None
        return self.record.machine_id

    @property
    def capabilities(self) -> Capabilities:
        """What this machine can do, as far as it is known."""
        provider, machine = self._context.provider, getattr(self, 'machine', None)
        return provider.capabilities if machine is None else provider.capabilities_of(machine)

    @property
    def directory(self) -> str:
        """The agent's folder on the machine."""
        return self.capabilities.agent_directory or f'{AGENT_FOLDER}/{self.name}'

    @property
    def dds_file(self) -> str:
        """The path of the middleware's configuration on the machine."""
        return f'{self.directory}/{self._context.dds.file_name}'

    def enter(self, phase: Phase, reason: str = '') -> None:
        """Enter a phase, unless it comes too late."""
        self.life = self.life.then(phase, reason)

    def survives(self, *, stopped: bool = False) -> bool:
        """Return whether the launch has to clean it up; see :meth:`Life.survives`."""
        return self.life.survives(
            self.spec.on_exit, owned=self._context.capabilities.owned, stopped=stopped)

    def run(self, *commands: Command, timeout: Optional[float] = None) -> str:
        """
        Run commands on the machine; return the last one's output.

        :raises ShellError: one failed, or the machine does not answer.
        :raises Cancelled: the launch is ending, and the machine still came up.
        """
        output, ending = '', self.ending.is_set()
        for command in commands:
            seconds = timeout or self._context.timeouts.vpn
            output = self.shell.run(
                command, timeout=self.timeout(seconds) if ending else seconds,
                cancel=None if ending else self.cancel).stdout
        return output

    def clean_up(self, commands: Iterable[Command]) -> str:
        """Run commands on the machine on the way down; see the base class."""
        output = ''
        for command in commands:
            seconds = self.timeout(min(self._context.timeouts.vpn, SILENCE_TIMEOUT))
            try:
                try:
                    output = self.shell.run(command, timeout=seconds).stdout
                except ConnectError:
                    # the connection may break though the machine is there
                    if self._out_of_reach or not self._answers():
                        raise
                    output = self.shell.run(command, timeout=seconds).stdout
            except (ConnectError, DeadlineExceeded):
                self._out_of_reach = True
                raise
        return output

    def release(self) -> None:
        """Make the agent stop the nodes and release the machine."""
        if self.rearming is not None:
            self.rearming.close()
        try:
            # answered when the nodes have ended; an agent out of reach ends them by itself
            self.agent.request(
                'release', timeout=self.timeout(self._context.timeouts.command),
                silent=SILENCE_TIMEOUT, launch=self._context.launch_id,
                on_exit=self.spec.on_exit, exit=not self.capabilities.agent_program)
        except AgentAbsent:
            pass
        except DeadlineExceeded:
            self._out_of_reach = True
            raise

    def timeout(self, seconds: float) -> float:
        """
        Return the time-out in seconds of an undo step that needs the machine.

        :param seconds: the time-out if the machine answers; the first call checks whether it does.
        """
        if self._out_of_reach is None:
            self._out_of_reach = not self._answers()
        return min(seconds, SHORT_TIMEOUT) if self._out_of_reach else seconds

    def _answers(self) -> bool:
        for probe in self.probes:
            try:
                probe(ANSWER_TIMEOUT)
                return True
            except DeadlineExceeded:
                return False
            except FogError:
                pass  # the agent has ended; the machine may still be there
        return False


class Step:
    """A step of a machine's deployment."""

    def __init__(self, context: Context, job: MachineJob) -> None:
        self._context = context
        self._job = job


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
