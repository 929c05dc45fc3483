# SPDX-License-Identifier: Apache-2.0
"""The live state, over a store and a provider in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses
from decimal import Decimal
import json
import os
from pathlib import Path
import time
from typing import Any

import pytest

from fogros2.errors import MachineNotFound, NameTaken, ProviderError
from fogros2.feature import Feature
from fogros2.journal import Journal
from fogros2.model import Endpoint, Machine, MachineSpec, MachineState
from fogros2.provider import TAG_NAME, TAG_ROBOT
from fogros2.report import silent, StepDone, StepStarted
from fogros2.store import Record, robot_name, Store, this_process
from fogros2.waiting import wait_until
from fogros2_testing.fakes import MemoryProvider
from fogros2_testing.plugins import instead
from ros2fog_cli.api.live import Live


class Memory(MemoryProvider):
    """One with a machine that can't be deleted."""

    def destroy(self, machine_id: str) -> None:
        if machine_id == 'id-stuck':
            raise ProviderError('the cloud said no', 'ask again')
        super().destroy(machine_id)


@pytest.fixture(autouse=True)
def provider(monkeypatch: pytest.MonkeyPatch) -> None:
    Memory.machines = {}
    instead(monkeypatch, 'fogros2.provider', {'memory': Memory})


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> Iterator[Live]:
    monkeypatch.setattr('ros2fog_cli.api.live.LOOK', 0.02)
    made = Live()
    made.start()
    wait_until(lambda: 'machines' in made.state(), timeout=60.0, what='the first look')
    yield made
    made.close()


def machine(name: str, **changes: Any) -> Record:
    Memory.machines[f'id-{name}'] = Machine(
        f'id-{name}', name, 'memory', MachineState.RUNNING, time.time() - 600,
        Endpoint('ssh', '198.51.100.7', 22, 'fog'), cost_per_hour=Decimal('0.6'),
        tags={TAG_NAME: name, TAG_ROBOT: robot_name()})
    made = Record(name, 'memory', MachineSpec(name, 'memory'), machine_id=f'id-{name}',
                  created=time.time() - 600, launch='abc123')
    return Store().save(dataclasses.replace(made, **changes))


def when(live: Live, name: str, fits: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """Return a machine of the state once it is as it should be."""
    def found() -> Any:
        return next((one for one in live.state()['machines']
                     if one['name'] == name and fits(one)), None)

    answer: dict[str, Any] = wait_until(found, timeout=60.0, what=name)
    return answer


def test_machine_is_shown_from_its_steps_to_its_end(live: Live) -> None:
    assert live.state(0, 5.0)['machines'] == []
    folder = Store().launch_folder('abc123')
    (folder / 'process.json').write_text(json.dumps(this_process()))
    keep = Journal(silent, folder)
    keep(StepStarted('', 'VPN interface'))
    keep(StepStarted('a', 'machine'))
    machine('a', **this_process())
    shown = when(live, 'a', lambda one: bool(one['steps']))
    assert shown['phase'] == 'coming' and shown['launch_pid'] == os.getpid()
    keep(StepDone('a', 'machine', 1.5, 'there'))
    shown = when(live, 'a', lambda one: one['steps'][0]['state'] == 'done')
    assert shown['steps'][0]['detail'] == 'there'
    shown = when(live, 'a', lambda one: one['cost_per_hour'] is not None)
    assert shown['cost_per_hour'] == 0.6 and shown['address'] == '198.51.100.7'
    (launch,) = live.state()['launches']
    assert launch['alive'] and [step['step'] for step in launch['steps']] == ['VPN interface']
    json.dumps(live.state())

    version = live.state()['version']
    begin = time.monotonic()
    assert live.state(version, 0.3)['version'] == version
    assert time.monotonic() - begin >= 0.3

    keep(StepStarted('a', 'delete'))
    when(live, 'a', lambda one: one['phase'] == 'ending')
    Memory.machines.clear()
    Store().delete('a')
    shown = when(live, 'a', lambda one: one['phase'] == 'gone')
    assert shown['ended'] and not shown['launch_alive']
    assert [step['state'] for step in shown['steps']] == ['done', 'done']
    with pytest.raises(MachineNotFound):
        live.delete('a')


def test_deletion_is_refused_forced_and_reported(live: Live) -> None:
    machine('a', **this_process())
    machine('stuck')
    when(live, 'a', lambda one: one['cost_per_hour'] is not None and one['launch_pid'])
    with pytest.raises(NameTaken, match='has the machine'):
        live.delete('a')
    assert 'id-a' in Memory.machines
    live.delete('a', force=True)
    wait_until(lambda: 'id-a' not in Memory.machines, timeout=60.0, what='its end')
    live.delete('stuck', force=True)
    shown = when(live, 'stuck', lambda one: bool(one['trouble']))
    assert 'the cloud said no' in shown['trouble'] and not shown['deleting']
    with pytest.raises(MachineNotFound):
        live.delete('nobody')


def test_orphan_is_shown_and_another_robots_machine_is_not(
    request: pytest.FixtureRequest,
) -> None:
    machine('orphan')
    Store().delete('orphan')
    machine('others')
    Store().delete('others')
    Memory.machines['id-others'] = dataclasses.replace(
        Memory.machines['id-others'], tags={TAG_NAME: 'others', TAG_ROBOT: 'another'})
    live = request.getfixturevalue('live')
    assert '(orphan)' in when(live, 'orphan', lambda one: True)['state']
    assert [one['name'] for one in live.state()['machines']] == ['orphan']


def test_machines_of_one_name_are_separate(request: pytest.FixtureRequest) -> None:
    """As in two regions, of launches that this robot has forgotten; then a launch has a third."""
    for number in '12':
        machine('a')
        Memory.machines[f'id-{number}'] = dataclasses.replace(
            Memory.machines.pop('id-a'), id=f'id-{number}', region=f'region-{number}')
    Store().delete('a')
    live = request.getfixturevalue('live')

    def shown() -> dict[str, str]:
        return {one['key']: one['id'] for one in live.state()['machines'] if not one['ended']}

    wait_until(lambda: len(shown()) == 2, timeout=60.0, what='both')
    assert shown() == {'a': 'id-1', 'a id-2': 'id-2'}
    Store().save(Record('a', 'memory', MachineSpec('a', 'memory'), **this_process()))
    wait_until(lambda: shown().get('a') is None, timeout=60.0, what='the third')
    machine('a', **this_process())
    wait_until(lambda: shown() == {'a': 'id-a', 'a id-1': 'id-1', 'a id-2': 'id-2'},
               timeout=60.0, what='all three')
    live.delete('a id-2')
    wait_until(lambda: 'a id-2' not in shown(), timeout=60.0, what='its end')
    assert set(Memory.machines) == {'id-a', 'id-1'}
    assert shown() == {'a': 'id-a', 'a id-1': 'id-1'}


def test_dead_launch_and_damaged_record_are_shown(live: Live) -> None:
    machine('left', pid=1 << 22, pid_start=1)
    Store().machine('torn').mkdir(parents=True)
    (Store().machine('torn') / 'record.json').write_text('{')
    shown = when(live, 'left', lambda one: 'launch gone' in one['state'])
    assert not shown['launch_alive'] and shown['phase'] == 'running'
    assert 'record damaged' in when(live, 'torn', lambda one: True)['state']


def test_defect_of_a_feature_leaves_its_last_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    class Mine(Feature):
        headings = ('A',)
        rows = [OSError('replaced'), [{'a': 1}]]

        def figures(self, folder: Path, machine: str) -> Any:
            now = self.rows[-1]
            if isinstance(now, OSError):
                raise now
            return now

    instead(monkeypatch, 'fogros2.feature', {'mine': Mine})
    monkeypatch.setattr('ros2fog_cli.api.live.LOOK', 0.02)
    machine('a', **this_process())
    live = Live()
    live.start()
    try:
        wait_until(lambda: live.state().get('machines'), timeout=60.0, what='the first look')
        when(live, 'a', lambda one: one['mine'] == [{'a': 1}] and not one['problems'])
        rows = Mine.rows.pop()
        when(live, 'a', lambda one: one['mine'] == [{'a': 1}]
             and 'mine: OSError: replaced' in one['problems'])
        Mine.rows.append(rows)
        when(live, 'a', lambda one: not one['problems'])
    finally:
        live.close()


def test_nothing_is_polled_while_nobody_watches(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr('ros2fog_cli.api.live.LOOK', 0.02)
    monkeypatch.setattr('ros2fog_cli.api.live.PRESENT', 0.2)
    monkeypatch.setattr(Store, 'machines', lambda store: asked.append(time.monotonic()) or [])
    live = Live()
    live.start()
    try:
        wait_until(lambda: asked and time.monotonic() - asked[-1] > 0.5, timeout=60.0,
                   what='quiet')
        before = len(asked)
        live.state(-1, 0.0)
        wait_until(lambda: len(asked) > before, timeout=60.0, what='a look')
    finally:
        live.close()
