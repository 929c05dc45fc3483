# SPDX-License-Identifier: Apache-2.0
"""The offset of a machine's clock: measured, chosen, warned of, kept and shown."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import json
from pathlib import Path
import socket
import threading
import time
from typing import Optional

import pytest

from fogros2 import journal
from fogros2.agent.protocol import ANSWER, BEAT, sign, verify
from fogros2.agent_client import Heartbeat
from fogros2.clock import ClockOffset, OffsetAlarm, OffsetFilter, SAMPLES
from fogros2.deploy.steps.watching import ClockComparison
from fogros2.model import MachineSpec
from fogros2.report import ClockMeasured, Event
from fogros2.store import Record, Store, this_process
from fogros2.waiting import wait_until
from ros2fog_cli.api import doctor, reach


def about(offset: Optional[ClockOffset], seconds: float, uncertainty: float) -> bool:
    return offset is not None and (offset.seconds, offset.uncertainty) == (
        pytest.approx(seconds, abs=1e-6), pytest.approx(uncertainty))


def test_offset_is_taken_at_the_middle_of_the_round_trip() -> None:
    # sent at 999.9, answered there at 1001.15, back here at 1000.3
    assert about(OffsetFilter().add(0.4, here=1000.3, there=1001.15), 1.05, 0.2)


def test_shortest_of_the_last_round_trips_counts() -> None:
    chosen = OffsetFilter()
    assert about(chosen.add(0.010, 100.0, 100.1), 0.105, 0.005)
    assert about(chosen.add(0.040, 100.0, 100.1), 0.105, 0.005)
    for _ in range(SAMPLES):
        last = chosen.add(0.020, 100.0, 100.1)
    assert about(last, 0.11, 0.010)


def test_newest_of_equal_round_trips_counts() -> None:
    chosen = OffsetFilter()
    chosen.add(0.01, 100.0, 100.0)
    assert about(chosen.add(0.01, 100.0, 100.004), 0.009, 0.005)


def test_clock_that_was_set_starts_the_measurement_anew() -> None:
    chosen = OffsetFilter()
    chosen.add(0.001, 100.0, 105.0)
    assert about(chosen.add(0.2, 100.0, 100.0), 0.1, 0.1)


@pytest.mark.parametrize(('offsets', 'warned'), [
    ([(0.04, 0.001)], [False]),
    ([(0.06, 0.001), (0.07, 0.001), (-0.3, 0.001)], [True, False, False]),
    ([(-0.06, 0.001)], [True]),
    # the excess is 10 ms, and the round trip leaves open 20 ms
    ([(0.06, 0.02), (0.06, 0.009)], [False, True]),
    # about the limit it is one and the same trouble; below half of it, it was repaired
    ([(0.06, 0.0), (0.045, 0.0), (0.06, 0.0)], [True, False, False]),
    ([(0.06, 0.0), (0.01, 0.0), (0.06, 0.0)], [True, False, True]),
])
def test_warning_comes_once_and_only_when_certain(
    offsets: list[tuple[float, float]], warned: list[bool],
) -> None:
    alarm = OffsetAlarm()
    assert not alarm.due(None)
    assert [alarm.due(ClockOffset(*one)) for one in offsets] == warned


@pytest.mark.parametrize(('offset', 'text'), [
    (ClockOffset(1.2, 0.0002), "1.20 s ahead of the robot's (± 0.2 ms)"),
    (ClockOffset(-0.0123, 0.0002), "12.3 ms behind the robot's (± 0.2 ms)"),
    (ClockOffset(-0.0001, 0.0002), "the same as the robot's (± 0.2 ms)")])
def test_offset_in_words(offset: ClockOffset, text: str) -> None:
    assert str(offset) == text


# -- by the heartbeat --------------------------------------------------------------------


KEY = '5a' * 32


@contextlib.contextmanager
def answering(clock: Callable[[], float]) -> Iterator[Heartbeat]:
    """Yield the heartbeat of a robot whose machine has the time that a function returns."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as machine:
        machine.bind(('127.0.0.1', 0))
        over = threading.Event()

        def serve() -> None:
            machine.settimeout(0.1)
            while not over.is_set():
                with contextlib.suppress(TimeoutError):
                    data, robot = machine.recvfrom(2048)
                    beat = verify(KEY, BEAT, data)
                    assert beat is not None
                    machine.sendto(sign(KEY, ANSWER.pack(*beat, clock())), robot)

        thread = threading.Thread(target=serve)
        thread.start()
        heartbeat = Heartbeat('127.0.0.1', machine.getsockname()[1], KEY, interval=0.02)
        try:
            yield heartbeat
        finally:
            heartbeat.close()
            over.set()
            thread.join()


def until(condition: Callable[[], object]) -> None:
    wait_until(condition, timeout=60, what='the condition of the test')


def test_heartbeat_measures_the_machines_clock() -> None:
    with answering(lambda: time.time() - 3) as heart:
        until(lambda: heart.clock_offset is not None)
        offset = heart.clock_offset
        assert offset is not None and 0 < offset.uncertainty < 1
        assert abs(offset.seconds + 3) <= offset.uncertainty + 0.001


@pytest.mark.parametrize('clock', [1e300, float('nan'), float('inf')])
def test_heartbeat_with_an_invalid_clock_is_ignored(clock: float) -> None:
    asked: list[float] = []

    def invalid() -> float:
        asked.append(clock)
        return clock

    with answering(invalid) as heart:
        until(lambda: len(asked) > 3)
        assert heart.clock_offset is heart.round_trip is None


class Measured:
    """Stands for a heartbeat: each look finds the next offset, at the end the last."""

    def __init__(self, *offsets: Optional[ClockOffset]) -> None:
        self.offsets = list(offsets)

    @property
    def clock_offset(self) -> Optional[ClockOffset]:
        return self.offsets.pop(0) if len(self.offsets) > 1 else self.offsets[0]


def test_launch_reports_changes_alone() -> None:
    first, same, better, far = (
        ClockOffset(0.010, 0.004), ClockOffset(0.012, 0.003), ClockOffset(0.011, 0.001),
        ClockOffset(0.2, 0.004))
    heartbeat = Measured(None, first, first, same, better, far, far)
    events: list[Event] = []
    comparison = ClockComparison('planner', heartbeat, events.append, interval=0.01)  # type: ignore
    until(lambda: len(events) == 3 and len(heartbeat.offsets) == 1)
    comparison.close()
    assert events == [
        ClockMeasured('planner', first), ClockMeasured('planner', better),
        ClockMeasured('planner', far, warn=True)]


# -- kept and shown ----------------------------------------------------------------------


def launched(store: Store, name: str, *lines: str) -> Record:
    """Return the record of a machine of this very process's launch, with that journal."""
    (store.launch_folder('abc123') / journal.FILE).write_text('\n'.join(lines))
    record = Record(name, 'container', MachineSpec(name, 'container'), launch='abc123',
                    **this_process())
    return store.save(record)


def test_journal_keeps_the_last_offset(tmp_path: Path) -> None:
    keep = journal.Journal(lambda event: None, tmp_path, clock=lambda: 5.0)
    for offset in (ClockOffset(0.1, 0.01), ClockOffset(0.2, 0.01)):
        keep(ClockMeasured('planner', offset))
    with (tmp_path / journal.FILE).open('a') as file:
        file.write('{"machine": "planner", "event": "clock", "seconds": "x"}\n[]\n7\n')
    assert journal.read(tmp_path).clocks == {'planner': ClockOffset(0.2, 0.01)}
    assert journal.read(tmp_path).steps == []
    assert journal.read(tmp_path / 'none').clocks == {}


def test_status_and_doctor_show_the_offset_of_a_running_launch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path))
    store = Store()
    assert doctor.clocks().verdict == 'ok'
    line = json.dumps({'machine': 'slam', 'event': 'clock', 'seconds': 0.07, 'uncertainty': 0.001})
    record = launched(store, 'slam', line)
    assert reach.clock(record, store) == ClockOffset(0.07, 0.001)
    check = doctor.clocks()
    assert (check.verdict, check.detail) == (
        'warning', "slam: 70.0 ms ahead of the robot's (± 1.0 ms)")
    assert 'chrony' in check.remedy
    launched(store, 'slam', line.replace('0.07', '0.02'))
    assert doctor.clocks().verdict == 'ok' and '20.0 ms' in doctor.clocks().detail
    launched(store, 'slam')
    assert reach.clock(record, store) is None and doctor.clocks().verdict == 'ok'
