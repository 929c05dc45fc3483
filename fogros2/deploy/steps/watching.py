# SPDX-License-Identifier: Apache-2.0
"""Compare a machine's clock with the robot's, and ask the provider about a silent machine."""

from __future__ import annotations

from collections.abc import Callable
import functools
import threading
import time
from typing import Optional

from fogros2.agent_client import Heartbeat
from fogros2.clock import ClockOffset, OffsetAlarm
from fogros2.deploy.context import Context
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

_ENDED = {
    MachineState.DELETED: 'it was deleted', MachineState.STOPPING: 'it is being ended',
    MachineState.STOPPED: 'it was stopped'}


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
    provider answers for ``LOSS`` seconds; a computer that FogROS2 does not own has no provider.
    With a ``limit``, it is lost after so many seconds of silence, whatever its provider reports.
    An unknown exception is a defect of FogROS2 or of a plugin: it ends the watch and is reported
    at once, and ``close`` raises it, so that the nodes continue until then.

    :param gone: called with the reason, once, from the watch's thread.
    :param found: called with the provider's report of a machine that runs.
    :param lost: called instead of ``gone`` for a lost machine, which may still run.
    """

    def __init__(
        self, context: Context, job: MachineJob, *,
        gone: Callable[[str], None], found: Callable[[Machine], None],
        lost: Callable[[str], None] = lambda reason: None,
    ) -> None:
        super().__init__(context, job)
        self._gone = gone
        self._found = found
        self._lost = lost
        self._alarm = SilenceAlarm()
        self.limit: Optional[float] = None
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
        if due is not None:
            self._context.report(Silence(self._job.name, *due))
        if self.limit is not None:
            if age > self.limit:
                self._end(self._lost, f'it is lost: no answer for {age:.0f} s')
        elif min(age, time.monotonic() - self._word_at) > LOSS:
            self._end(self._lost, f'it is lost: no answer for {age:.0f} s, and no word of its '
                      'provider')

    def _ask(self) -> Optional[float]:
        age = self._job.heartbeat.age
        if age is None or age <= SILENCE:
            return None
        deleted = False
        try:
            machine = self._context.provider.describe(self._job.machine_id)
        except MachineNotFound as error:
            reason, deleted = str(error.args[0]), True
        except FogError:
            return POLL_INTERVAL  # perhaps the robot has no network: retried
        else:
            self._word_at = time.monotonic()
            reason, deleted = _ENDED.get(machine.state, ''), machine.state is MachineState.DELETED
            if machine.state is MachineState.RUNNING and not self._closed.is_set():
                self._found(machine)
        if reason:
            self._end(functools.partial(self._is_gone, deleted), reason)
        return POLL_INTERVAL

    def _is_gone(self, deleted: bool, reason: str) -> None:
        self._job.gone, self._job.deleted = True, deleted
        self._gone(reason)

    def _end(self, tell: Callable[[str], None], reason: str) -> None:
        with self._ending:
            # while the agent sends, the machine exists, whatever the provider reports
            if self._closed.is_set() or self._job.agent.silent_for <= SILENCE:
                return
            self._closed.set()
        tell(reason)
