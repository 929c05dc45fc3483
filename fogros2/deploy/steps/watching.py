# SPDX-License-Identifier: Apache-2.0
"""Compare a machine's clock with the robot's, and ask the provider about a silent machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import threading
import time
from typing import Optional

from fogros2.agent_client import Heartbeat
from fogros2.clock import ClockOffset, OffsetAlarm
from fogros2.deploy.context import Context
from fogros2.deploy.life import Phase
from fogros2.deploy.machine_job import MachineJob, Step
from fogros2.errors import FogError, MachineNotFound
from fogros2.model import Machine, MachineState
from fogros2.report import ClockMeasured, Reporter, Silence, StepFailed
from fogros2.waiting import Periodic

#: Seconds without an answer to a heartbeat after which a machine is silent: two are missing.
SILENCE = 4.6
#: Poll interval in seconds of the provider of a silent machine.
POLL_INTERVAL = 5.0
#: Seconds without an answer of machine and provider after which a machine is lost.
LOSS = 37.0

#: Seconds without a silence after which the next one is reported as the first.
CALM = 600.0

_ENDED: Mapping[MachineState, tuple[Phase, str]] = {
    MachineState.DELETED: ('deleted', 'it was deleted'),
    MachineState.STOPPING: ('stopped', 'it is being ended'),
    MachineState.STOPPED: ('stopped', 'it was stopped')}


class ClockComparison:
    """
    Report the offset of a machine's clock when it changes, and warn if it is large.

    A separate thread reports: a report may block on a terminal, and a heartbeat must not block.
    """

    def __init__(
        self, machine: str, heartbeat: Heartbeat, report: Reporter,
        interval: float = POLL_INTERVAL,
    ) -> None:
        self._machine = machine
        self._heartbeat = heartbeat
        self._report = report
        self._alarm = OffsetAlarm()
        self._reported: Optional[ClockOffset] = None
        self.close = Periodic('fog-clock', interval, self._compare, first=0.0).close

    def _compare(self) -> None:
        offset, before = self._heartbeat.clock_offset, self._reported
        warn = self._alarm.due(offset)
        if offset is not None and (
                warn or before is None or offset.contradicts(before)
                or offset.uncertainty < before.uncertainty / 2):
            self._report(ClockMeasured(self._machine, offset, warn))
            self._reported = offset


class SilenceAlarm:
    """
    Decide which silence to report: the first one, each that is twice as long, and their ends.

    A busy computer or a bad network causes many short silences.
    """

    def __init__(self) -> None:
        self._limit, self._seconds, self._last = SILENCE, 0.0, 0.0
        self._reported = False

    def due(self, age: float, now: float) -> Optional[tuple[float, bool]]:
        """
        Return the seconds of a silence to report, and whether it is over, or None.

        :param age: seconds since the last answer.
        :param now: on a monotonic clock.
        """
        if age > SILENCE:
            self._seconds, self._last = age, now
            if age > self._limit:
                self._limit, self._reported = 2 * age, True
                return age, False
        elif self._reported:
            self._reported = False
            return self._seconds, True
        elif now - self._last > CALM:
            self._limit = SILENCE
        return None


class Watch(Step):
    """
    Report a machine that does not answer, and ask its provider whether the machine is gone.

    A machine that exists but is out of reach is not gone. It is lost if neither it nor its
    provider answers for ``LOSS`` seconds, or the job's ``least_silence`` if that is longer; a
    computer that FogROS2 does not own has no provider. With the job's ``longest_silence``, it is
    lost then, whatever its provider reports.
    An unknown exception is a defect of FogROS2 or of a plugin: it ends the watch and is reported
    at once, and ``close`` raises it, so that the nodes continue until then.

    :param over: called once, in the watch's thread, with the machine's phase and the reason.
    :param found: called with the provider's report of a machine that runs.
    """

    def __init__(
        self, context: Context, job: MachineJob, *,
        over: Callable[[Phase, str], None], found: Callable[[Machine], None],
    ) -> None:
        super().__init__(context, job)
        self._over = over
        self._found = found
        self._alarm = SilenceAlarm()
        self._closed = threading.Event()
        self._ending = threading.Lock()
        self._fault: Optional[BaseException] = None
        self._word_at = time.monotonic()
        # two threads: the provider's answer may take minutes
        self._periodic('fog-watch', 0.2, self._look)
        if context.capabilities.owned:
            self._periodic('fog-ask', 1.0, self._ask)

    def close(self) -> None:
        """
        Stop watching; ignore the answer to a pending question.

        :raises BaseException: the exception that ended the watch, once.
        """
        self._closed.set()
        fault, self._fault = self._fault, None
        if fault is not None:
            raise fault

    def _periodic(self, name: str, interval: float, work: Callable[[], Optional[float]]) -> None:
        def guarded() -> Optional[float]:
            try:
                return work()
            except BaseException as error:  # noqa: BLE001 - raised again by ``close``
                self._closed.set()
                self._fault = error
                self._context.report(StepFailed(
                    self._job.name, 'watch', 0.0, 'nobody looks any more whether the machine '
                    f'still exists: {type(error).__name__}: {error}', fatal=False))
                return None

        Periodic(name, interval, guarded, stop=self._closed)

    def _look(self) -> None:
        age = self._job.heartbeat.age or 0.0
        due = self._alarm.due(age, time.monotonic())
        if due is not None and not self._job.announced:
            self._context.report(Silence(self._job.name, *due))
        if (limit := self._job.longest_silence) is not None:
            if age > limit:
                self._end('lost', f'it is lost: no answer for {age:.0f} s')
        elif min(age, time.monotonic() - self._word_at) > max(
                LOSS, self._job.least_silence):
            self._end('lost', f'it is lost: no answer for {age:.0f} s, and no word of its '
                      'provider')

    def _ask(self) -> Optional[float]:
        age = self._job.heartbeat.age
        if age is None or age <= SILENCE:
            return None
        try:
            machine = self._context.provider.describe(self._job.machine_id)
        except MachineNotFound as error:
            self._end('deleted', str(error.args[0]))
        except FogError:
            pass  # perhaps the robot has no network: retried
        else:
            self._word_at = time.monotonic()
            if machine.state in _ENDED:
                self._end(*_ENDED[machine.state])
            elif machine.state is MachineState.RUNNING and not self._closed.is_set():
                self._found(machine)
        return POLL_INTERVAL

    def _end(self, phase: Phase, reason: str) -> None:
        with self._ending:
            # while the agent sends, the machine exists, whatever the provider reports
            if self._closed.is_set() or self._job.agent.silent_for <= SILENCE:
                return
            self._closed.set()
        self._over(phase, reason)
