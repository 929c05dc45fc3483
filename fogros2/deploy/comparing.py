# SPDX-License-Identifier: Apache-2.0
"""Compare a machine's clock with the robot's clock while the launch runs."""

from __future__ import annotations

import threading
from typing import Optional

from fogros2.agent_client import Heartbeat
from fogros2.clock import ClockOffset, OffsetAlarm
from fogros2.report import ClockMeasured, Reporter

#: Poll interval of the heartbeat's measurements, in seconds.
INTERVAL = 5.0


class Comparison:
    """
    Report the offset of a machine's clock when it changes, and warn if it is large.

    A separate thread reports: a report may block on a terminal, and a heartbeat must not block.

    :param interval: poll interval in seconds.
    """

    def __init__(
        self, machine: str, heartbeat: Heartbeat, report: Reporter, interval: float = INTERVAL,
    ) -> None:
        self._machine = machine
        self._heartbeat = heartbeat
        self._report = report
        self._alarm = OffsetAlarm()
        self._reported: Optional[ClockOffset] = None
        self._interval = interval
        self._done = threading.Event()
        threading.Thread(target=self._run, name='fog-clock', daemon=True).start()

    def close(self) -> None:
        """Stop comparing."""
        self._done.set()

    def _run(self) -> None:
        while True:
            offset, before = self._heartbeat.clock_offset, self._reported
            warn = self._alarm.due(offset)
            if offset is not None and (
                    warn or before is None or offset.contradicts(before)
                    or offset.uncertainty < before.uncertainty / 2):
                self._report(ClockMeasured(self._machine, offset, warn))
                self._reported = offset
            if self._done.wait(self._interval):
                return
