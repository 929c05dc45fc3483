# SPDX-License-Identifier: Apache-2.0
"""Compare a machine's clock with the robot's, and ask the provider about a silent machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Optional

from fogros2.agent_client import Heartbeat
from fogros2.clock import ClockOffset, OffsetAlarm
from fogros2.deploy.context import Context
from fogros2.deploy.machine_job import MachineJob, Step
from fogros2.errors import FogError, MachineNotFound
from fogros2.model import Machine, MachineState
from fogros2.report import ClockMeasured, Reporter, StepFailed
from fogros2.waiting import Periodic

#: Seconds without a heartbeat before the provider is asked, and the poll interval after that.
SILENCE, POLL_INTERVAL = 5.0, 5.0

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


class Watch(Step):
    """
    Ask the provider about a machine without heartbeat, until the machine is known to be gone.

    A machine that exists but is out of reach is not reported. An unknown exception is a defect of
    FogROS2 or of a plugin: it ends the watch and is reported at once, and ``close`` raises it, so
    that the nodes continue until then.

    :param gone: called with the reason, once, from the watch's thread.
    :param found: called with the provider's report of a machine that runs.
    """

    def __init__(
        self, context: Context, job: MachineJob, *,
        gone: Callable[[str], None], found: Callable[[Machine], None],
    ) -> None:
        super().__init__(context, job)
        self._gone = gone
        self._found = found
        self._closed = False
        self._fault: Optional[BaseException] = None
        self._polls = Periodic('fog-watch', 1.0, self._poll)

    def close(self) -> None:
        """
        Stop watching; ignore the answer to a pending question.

        :raises BaseException: the exception that ended the watch, once.
        """
        self._closed = True
        self._polls.close()
        fault, self._fault = self._fault, None
        if fault is not None:
            raise fault

    def _poll(self) -> Optional[float]:
        try:
            return self._look()
        except BaseException as error:  # noqa: BLE001 - raised again by ``close``
            self._polls.close()
            self._fault = error
            self._context.report(StepFailed(
                self._job.name, 'watch', 0.0, 'nobody looks any more whether the machine still '
                f'exists: {type(error).__name__}: {error}', fatal=False))
            return None

    def _look(self) -> Optional[float]:
        job, age = self._job, self._job.heartbeat.age
        if age is None or age <= SILENCE:
            return None
        reason, deleted = self._ask()
        # while the agent sends, the machine exists, whatever the provider reports
        if reason and job.agent.silent_for > SILENCE and not self._closed:
            job.gone, job.deleted = True, deleted
            self._polls.close()
            self._gone(reason)
        return POLL_INTERVAL

    def _ask(self) -> tuple[str, bool]:
        """Return why the machine ended ('' if it runs or is unknown), and if it is deleted."""
        try:
            machine = self._context.provider.describe(self._job.machine_id)
        except MachineNotFound as error:
            return str(error.args[0]), True
        except FogError:
            return '', False  # perhaps the robot has no network: retried
        if machine.state is MachineState.RUNNING and not self._closed:
            self._found(machine)
        return _ENDED.get(machine.state, ''), machine.state is MachineState.DELETED
