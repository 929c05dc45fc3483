# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog`` through ros2cli's own entry point, over a provider that lives in memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import dataclasses
from decimal import Decimal
import functools
import importlib.util
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time
from typing import Any, Optional
from unittest.mock import Mock

import pytest
from ros2cli.cli import main

from fogros2 import feature, process, report, ros2_daemon
from fogros2.deploy import undo
from fogros2.errors import (
    ConnectError,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
    ProviderError,
    Unsupported,
)
from fogros2.model import (
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
    Result,
    VpnInterface,
)
from fogros2.provider import Capabilities, TAG_EXPIRES, TAG_LAUNCH, TAG_NAME, TAG_ROBOT
from fogros2.provider.container import ContainerProvider
from fogros2.store import Made, process_start, Record, robot_name, Store, this_process
from fogros2.vpn.wireguard import WireGuard
from fogros2_testing.fakes import FakeShell, FakeStream, MemoryProvider
from fogros2_testing.plugins import instead
from rigs import recorded_agent
from ros2fog_cli.api import endings, machines, table
from ros2fog_cli.api.machines import Entry

NOW = 1_800_000_000.0
LAB_VPN = VpnInterface('fogabc123m0', '198.18.0.2', '198.18.0.0/24', 51820, '/none')


class Memory(MemoryProvider):
    """One with a machine that can't be deleted."""

    searched: list[str] = []

    def destroy(self, machine_id: str) -> None:
        if machine_id == 'stuck':
            raise ProviderError('the cloud said no', 'ask again')
        super().destroy(machine_id)

    def search_in(self, regions: list[str]) -> None:
        type(self).searched = regions


class Untagged(Memory):
    """One that keeps no tags."""

    name = 'untagged'
    machines: dict[str, Machine] = {}

    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        raise Unsupported('no tags here')


@pytest.fixture(autouse=True)
def providers(monkeypatch: pytest.MonkeyPatch) -> None:
    classes: dict[str, type[Memory]] = {'memory': Memory, 'untagged': Untagged}
    for provider in classes.values():
        provider.machines = {}
        provider.searched = []
    instead(monkeypatch, 'fogros2.provider', {
        **classes,
        'nosdk': PrerequisiteError("the provider 'nosdk' can't be loaded", 'pip install nosdk')})


def machine(name: str, machine_id: str = '', **changes: Any) -> Machine:
    tags = {TAG_NAME: name, TAG_ROBOT: changes.pop('robot', robot_name()),
            TAG_EXPIRES: str(int(changes.pop('expires', time.time() + 3600))),
            TAG_LAUNCH: 'abc123'}
    made = Machine(machine_id or f'id-{name}', name, 'memory', MachineState.RUNNING,
                   time.time() - 600, Endpoint('ssh', '198.51.100.7', 22, 'fog'), tags=tags)
    made = dataclasses.replace(made, **changes)
    (Memory if made.provider == 'memory' else Untagged).machines[made.id] = made
    return made


def record(name: str, machine_id: Optional[str] = '', provider: str = 'memory',
           on_exit: Any = 'delete', **changes: Any) -> Record:
    made = Record(name, provider, MachineSpec(name, provider, on_exit=on_exit),
                  machine_id=f'id-{name}' if machine_id == '' else machine_id,
                  created=time.time() - 600, launch='abc123')
    made = dataclasses.replace(made, **changes)
    return Store().save(made)


@functools.cache
def dead() -> dict[str, int]:
    child = subprocess.Popen(['true'])
    start = process_start(child.pid) or 1
    child.wait()
    return {'pid': child.pid, 'pid_start': start}


def lab(monkeypatch: pytest.MonkeyPatch, shell: FakeShell, **changes: Any) -> None:
    """Let a dead launch have used a host that answers by a shell."""
    monkeypatch.setattr(endings.reach.shells, 'connect', lambda *_, **__: shell)
    made = machine('lab', provider='untagged', owned=False)
    record('lab', **{
        'provider': 'untagged', 'endpoint': made.endpoint, 'agent': '/run/fogros2/lab',
        'agent_program': '/run/fogros2/lab/agent.py', **dead(), **changes})


def run(*words: str) -> Any:
    return main(argv=['fog', *words])


def test_list_without_machines(capsys: pytest.CaptureFixture[str]) -> None:
    assert run('list') == 0
    out = capsys.readouterr()
    assert out.out == 'no machines\n'
    # the others are listed; the one that can't be asked is a line on stderr
    assert out.err == "nosdk: the provider 'nosdk' can't be loaded (pip install nosdk)\n"


def test_list_goes_on_without_what_a_feature_cannot_list(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    def listed(regions: object) -> object:
        raise ProviderError('the service does not answer')

    instead(monkeypatch, 'fogros2.listed', {'mine': listed})
    machine('a')
    assert run('list', '--json') == 0
    out = capsys.readouterr()
    assert [one['name'] for one in json.loads(out.out)['machines']] == ['a']
    assert 'mine: the service does not answer' in out.err


def test_list_shows_what_providers_and_the_store_know(
    capsys: pytest.CaptureFixture[str],
) -> None:
    machine('alive', cost_per_hour=Decimal('0.0416'), region='eu-west-1', kind='t3.medium')
    record('alive', **this_process())
    machine('orphan', cost_per_hour=Decimal('1.2'))
    machine('other', robot='somebody-7')
    machine('idle', state=MachineState.STOPPED, cost_per_hour=Decimal('1.2'))
    record('idle', launch='')
    machine('widow')
    record('widow', **dead())
    record('ghost')
    machine('here', provider='untagged')
    record('here', provider='untagged', launch='')
    (Store().root / 'machines/broken').mkdir(mode=0o700)
    (Store().root / 'machines/broken/record.json').write_text('{')
    assert run('list') == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == [
        'NAME', 'PROVIDER', 'PLACE', 'KIND', 'STATE', 'AGE', 'ADDRESS', 'TIME', 'LEFT', 'COST/H',
        'COST']
    states = {line.split()[0]: line for line in lines[1:-1]}
    assert list(states) == ['alive', 'broken', 'ghost', 'here', 'idle', 'orphan', 'other', 'widow']
    assert ' running   ' in states['alive'] and '$0.0416  $0.01' in states['alive']
    assert 'eu-west-1  t3.medium' in states['alive']
    # what is stopped costs its disk alone; 10 minutes of the others
    assert '$' not in states['idle'] and 'min' not in states['idle'].split('198.51.100.7')[1]
    # the price of others is unknown
    assert lines[-1] == '$1.2416 an hour, $0.21 so far, disks and traffic aside; ' \
        'the price of 3 more is unknown'
    machine('idle', state=MachineState.STOPPED, cost_per_hour=Decimal('1.2'), billed=True)
    assert run('list') == 0
    (idle,) = [line for line in capsys.readouterr().out.splitlines() if 'idle' in line]
    assert 'stopped (still billed)' in idle and '$1.2000' in idle
    assert '10 min' in states['alive'] and '60 min' in states['alive']
    assert 'unknown (record damaged)' in states['broken']
    assert ' gone ' in states['ghost']
    assert states['here'].split()[:5] == ['here', 'untagged', '-', '-', 'running']
    assert 'stopped (keeps its disk)' in states['idle']
    assert 'running (orphan)' in states['orphan']
    assert 'running (robot somebody-7)' in states['other']
    assert 'running (launch gone)' in states['widow']


def test_list_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    machine('a', cost_per_hour=Decimal('0.5'), image='ami-1', key='fogros2-a', disk_gb=40,
            endpoint=Endpoint('ssh', '198.51.100.7', 22, 'fog', 'ssh-ed25519 AAAA'))
    record('a', **this_process())
    record('b')
    assert run('list', '--json') == 0
    entry, unknown = json.loads(capsys.readouterr().out)['machines']
    assert (entry['image'], entry['key'], entry['disk_gb']) == ('ami-1', 'fogros2-a', 40)
    assert (unknown['image'], unknown['key'], unknown['disk_gb']) == (None, None, None)
    assert (entry['host_key'], unknown['host_key']) == ('ssh-ed25519 AAAA', None)
    assert entry['name'] == 'a' and entry['provider'] == 'memory' and entry['id'] == 'id-a'
    assert entry['launch_alive'] is True and entry['cost_per_hour'] == 0.5
    assert entry['cost'] == pytest.approx(0.5 / 6, rel=0.01)
    assert 595 < entry['age'] < 700 and 3500 < entry['time_left'] < 3600


@pytest.mark.parametrize('words', [('list',), ('list', '--json'), ('status', 'a', '--json')])
def test_feature_that_does_not_load_ends_no_view(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Sums(feature.Feature):
        notes = {'sum': '{note} apples'}
        headings = ('APPLES',)

    instead(monkeypatch, 'fogros2.feature', {
        'old': PrerequisiteError("the feature 'old' can't be loaded"), 'sums': Sums})
    machine('a')
    record('a', **this_process(), notes={'sum': '7'})
    run(*words)
    shown = capsys.readouterr()
    assert ('a: 7 apples' if len(words) == 1 else '"sum": "7"') in shown.out
    assert shown.err.count("old: the feature 'old' can't be loaded\n") == 1


def test_region_is_passed_to_providers_with_regions(capsys: pytest.CaptureFixture[str]) -> None:
    assert run('list', '--region', 'eu-central-1', 'us-west-1') == 0
    assert Memory.searched == ['eu-central-1', 'us-west-1']
    for word in ('all', '*'):
        assert run('list', '--region', word) == 0
        assert Memory.searched == ['all']


def test_machine_of_another_robot_does_not_get_our_record() -> None:
    machine('slam', 'theirs', robot='somebody-7')
    record('slam', 'ours')
    found = machines.survey(lambda text: None)
    assert [(e.machine_id, e.own, e.gone) for e in found] == [
        ('theirs', False, False), ('ours', True, True)]


def test_delete_removes_machine_and_record(capsys: pytest.CaptureFixture[str]) -> None:
    machine('a')
    record('a', **dead())
    assert run('delete', 'a', '--dry-run') == 0
    assert 'would delete a' in capsys.readouterr().out
    assert 'id-a' in Memory.machines and Store().exists('a')
    assert run('delete', 'a', '--yes') == 0
    assert 'deleted a' in capsys.readouterr().out
    assert not Memory.machines and not Store().machine('a').exists()
    assert run('delete', 'a', '--yes') == 1
    assert "no machine 'a'" in capsys.readouterr().err


def test_delete_clears_leftovers_of_an_ended_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    destroyed: list[str] = []
    monkeypatch.setattr(Memory, 'destroy', lambda self, machine_id: destroyed.append(machine_id))
    record('a', **dead())
    record('b', machine_id=None, **dead())
    assert run('delete', 'a', '--yes') == 0 and run('delete', 'b', '--yes') == 0
    assert destroyed == ['id-a']
    assert not Store().exists('a')


def test_gc_deletes_machine_whose_id_was_not_saved(capsys: pytest.CaptureFixture[str]) -> None:
    machine('a')
    record('a', machine_id=None, **dead())
    machine('b', 'id-of-a-neighbour')
    record('b', machine_id=None, **{**dead(), 'launch': 'fedcba'})
    states = {entry.name: entry.state for entry in machines.survey(lambda text: None)}
    assert states['a'] == 'running (launch gone)'
    assert run('gc') == 0
    assert 'cleared machine a: its launch is gone' in capsys.readouterr().out
    assert [*Memory.machines] == ['id-of-a-neighbour']


@pytest.mark.parametrize('machine_id', ['id-a', None])
def test_machine_is_searched_where_its_record_names_it(
    monkeypatch: pytest.MonkeyPatch, machine_id: Optional[str],
) -> None:
    """Such as a pod of a namespace, with no right to list pods in another one."""
    def search_for(self: Memory, specs: Iterable[MachineSpec]) -> None:
        self.places = [spec.options['namespace'] for spec in specs]

    def find(self: Memory, tags: Any) -> list[Machine]:
        if self.places != ['robots']:
            raise ProviderError('the cluster refused listing jobs')
        return [*Memory.machines.values()]

    monkeypatch.setattr(Memory, 'places', [], raising=False)
    monkeypatch.setattr(Memory, 'search_for', search_for)
    monkeypatch.setattr(Memory, 'find', find)
    machine('a')
    ours = record('a', machine_id, **dead(), spec=MachineSpec(
        'a', 'memory', {'namespace': 'robots'}))
    (entry,) = machines.survey(lambda text: None)
    assert entry.state == 'running (launch gone)'
    if machine_id is None:
        endings.end_request(ours, 0.0, Store())
    else:
        assert run('delete', 'a', '--yes') == 0
    assert not Memory.machines


@pytest.mark.parametrize('words', [
    'gc --keep-stopped=-1', 'gc --keep-stopped=nan', 'price --limit=-1', 'wait a --timeout=inf'])
def test_wrong_number_is_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as wrong:
        run(*words.split())
    assert wrong.value.code == 2 and 'is no number from 0 on' in capsys.readouterr().err


def test_stopped_machine_is_not_connected_to() -> None:
    machine('a', state=MachineState.STOPPED)
    record('a', launch='')
    for verb in ('connect', 'logs'):
        said = run(verb, 'a')
        assert "'a' can't be reached: stopped" in said and 'starts it again' in said


def test_host_that_is_off_is_no_stopped_machine() -> None:
    found = machine('lab', provider='untagged', state=MachineState.STOPPED, owned=False)
    entry = Entry('lab', 'untagged', found, record('lab', provider='untagged', launch=''))
    assert entry.state == 'unknown (does not answer)'
    said = run('connect', 'lab')
    assert "can't be reached" in said and 'is it on?' in said and 'starts it again' not in said


def test_machine_that_a_launch_is_creating_is_pending() -> None:
    record('a', machine_id=None, **this_process())
    record('b', machine_id=None, **dead())
    assert [(entry.state, entry.gone) for entry in machines.survey(lambda text: None)] == [
        ('pending', False), ('gone', True)]
    assert "'a' can't be reached: pending" in run('connect', 'a')


def test_machines_are_listed_where_one_host_does_not_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def find(self: Memory, tags: Any) -> Iterator[Machine]:
        yield Memory.machines['id-there']
        raise ConnectError('the second host is off')

    def describe(self: Memory, machine_id: str) -> Machine:
        if machine_id == 'id-gone':
            raise MachineNotFound('none')
        raise ConnectError('the second host is off')

    for name in ('there', 'silent', 'gone'):
        record(name)
    record('unsaved', machine_id=None)  # its launch was killed before it had the id
    machine('there')
    monkeypatch.setattr(Memory, 'find', find)
    monkeypatch.setattr(Memory, 'describe', describe)
    warnings: list[str] = []
    found = {entry.name: entry for entry in machines.survey(warnings.append)}
    assert found['there'].machine is not None
    assert {name: entry.asked for name, entry in found.items()} == {
        'there': True, 'silent': False, 'gone': True, 'unsaved': False}
    assert 'memory: the second host is off' in warnings


def test_delete_asks_for_confirmation(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine('a')
    assert run('delete', 'a') == 1
    assert 'no terminal to ask at' in capsys.readouterr().err
    for answer, status in (('n', 1), ('', 1), ('y', 0)):
        monkeypatch.setattr('sys.stdin.isatty', lambda: True, raising=False)
        monkeypatch.setattr('builtins.input', lambda answer=answer: answer)
        assert run('delete', 'a') == status
    assert not Memory.machines
    machine('a')
    monkeypatch.setattr('builtins.input', Mock(side_effect=EOFError))  # Ctrl-D
    assert run('delete', 'a') == 1
    assert Memory.machines


def test_delete_refuses_under_a_running_launch(capsys: pytest.CaptureFixture[str]) -> None:
    machine('a')
    record('a', **this_process())
    said = run('delete', 'a', '--yes')
    assert 'has the machine' in str(said) and '--force' in str(said)
    assert Memory.machines
    assert run('delete', 'a', '--yes', '--force') == 0
    assert not Memory.machines
    # its launch takes the record down itself
    assert Store().exists('a')


@pytest.mark.parametrize('end', [
    lambda entry: endings.delete(entry, Store(), report.silent),
    lambda entry: endings.let_go(entry.record, entry.machine, Store())])
def test_machine_that_changed_meanwhile_stays(end: Any) -> None:
    """Such as while a verb waited for its user's answer."""
    machine('a')
    record('a', token='t1', last='abc123', **dead())
    (entry,) = machines.survey(lambda text: None)
    machine('a', 'id-2')
    new = record('a', 'id-2', token='t2', last='def456', launch='', on_exit='keep')
    Store().key_file('a').touch()
    with pytest.raises(NameTaken, match="'a' has changed meanwhile .*try again"):
        end(entry)
    assert Store().load('a') == new and Store().key_file('a').exists()
    assert [*Memory.machines] == ['id-a', 'id-2']


@pytest.mark.parametrize(('machine_id', 'refused'), [('id-a', True), (None, True), ('x', False)])
def test_machine_that_got_a_record_meanwhile_is_no_orphan(
    machine_id: Optional[str], refused: bool,
) -> None:
    machine('a')
    (entry,) = machines.survey(lambda text: None)
    assert entry.record is None
    record('a', machine_id, last='abc123', **this_process())
    if refused:
        with pytest.raises(NameTaken, match='has changed meanwhile'):
            endings.delete(entry, Store(), report.silent)
    else:
        endings.delete(entry, Store(), report.silent)
    assert bool(Memory.machines) == refused and Store().exists('a')


def test_leftovers_of_a_deleted_machine_are_not_recorded_again() -> None:
    machine('a')
    known = record('a', on_exit='keep', **dead())
    Store().delete('a')
    endings.let_go(known, Memory.machines['id-a'], Store())
    assert not Store().exists('a')


def test_delete_works_with_a_damaged_record() -> None:
    machine('a')
    folder = Store().machine('a')
    folder.mkdir(parents=True)
    (folder / 'record.json').write_text('nonsense')
    assert run('delete', 'a', '-y') == 0
    assert not Memory.machines and not folder.exists()


def test_unreadable_record_without_a_machine_needs_force(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A computer of the user has no tags by which it could be found."""
    folder = Store().machine('lab')
    folder.mkdir(parents=True)
    (folder / 'record.json').write_text('{}')
    assert run('delete', 'lab', '-y') == 1 and folder.exists()
    assert '--force' in capsys.readouterr().err
    assert run('delete', 'lab', '-y', '--force') == 0 and not folder.exists()


@pytest.mark.parametrize(('name', 'own', 'others'), [
    ('all', ['a', 'b'], ['--any-robot']),
    ('c', ['c'], [])])  # from any computer, where none of that name is its own
def test_delete_prefers_own_machines(
    capsys: pytest.CaptureFixture[str], name: str, own: list[str], others: list[str],
) -> None:
    for each in own:
        machine(each)
    machine('c', 'theirs', robot='somebody-7')
    assert run('delete', name, '--yes') == 0
    assert '1 of other robots left out' in capsys.readouterr().err
    assert list(Memory.machines) == ['theirs']
    assert run('delete', name, '--yes', *others) == 0
    assert not Memory.machines
    assert 'of the robot somebody-7' in capsys.readouterr().out


def test_failed_deletion_keeps_record_and_stops_no_other(
    capsys: pytest.CaptureFixture[str],
) -> None:
    machine('a', 'stuck')
    record('a', 'stuck', **dead())
    machine('b')
    assert run('delete', 'all', '-y') == 1
    out = capsys.readouterr()
    assert 'a: the cloud said no (ask again)' in out.err and 'deleted b' in out.out
    assert Store().exists('a')


def test_machine_of_a_silent_provider_is_not_forgotten() -> None:
    record('a', provider='nosdk', **dead())
    assert run('delete', 'a', '-y') == 1
    assert Store().exists('a')
    assert run('delete', 'a', '-y', '--force') == 0
    assert not Store().exists('a')


@pytest.mark.parametrize(('changes', 'record_changes', 'reason'), [
    ({}, {'launch': ''}, ''),
    ({}, {'pid': 1, 'pid_start': 1}, 'its launch is gone'),
    ({}, {'pid': 1, 'pid_start': 1, 'on_exit': 'keep'}, ''),
    ({'expires': NOW - 600}, {'launch': ''}, 'past its lifetime'),
    ({'expires': NOW - 30}, {'launch': ''}, ''),
    ({'expires': NOW - 600}, 'alive', ''),
    ({'expires': NOW - 600, 'robot': 'x-1'}, None, ''),
    ({'expires': NOW - 600}, None, 'past its lifetime'),
    ({'state': MachineState.STOPPED, 'created': NOW - 30 * 86400}, {'launch': ''}, 'stopped'),
    ({'state': MachineState.STOPPED, 'created': NOW - 3600}, {'launch': ''}, ''),
    # made, and not started yet; and of a launch that did not learn its id
    ({}, {'pid': 1, 'pid_start': 1, 'on_exit': 'stop', 'machine_id': None}, 'its launch is gone'),
    ({'state': MachineState.STOPPED}, {'pid': 1, 'pid_start': 1}, 'its launch is gone'),
    # a computer of the user that is off
    ({'state': MachineState.STOPPED, 'owned': False}, {'launch': '', 'created': 1.0}, ''),
    ({'state': MachineState.DELETED}, {'launch': ''}, 'gone at its provider'),
])
def test_gc_ends_machines_that_nobody_needs(
    changes: Any, record_changes: Any, reason: str,
) -> None:
    found = machine('a', **{'expires': NOW + 600, **changes})
    known = None
    if record_changes is not None:
        known = record('a', **(this_process() if record_changes == 'alive' else record_changes))
    entry = Entry('a', 'memory', found, known)
    said = endings.why_end(entry, NOW, 7 * 86400.0)
    assert said.startswith(reason) and bool(said) == bool(reason)


def test_gc_clears_and_reports_leftovers(capsys: pytest.CaptureFixture[str]) -> None:
    assert run('gc') == 0
    assert capsys.readouterr().out == 'nothing to clear\n'
    machine('old', expires=time.time() - 600)
    record('gone', **dead())
    machine('kept')
    record('kept', on_exit='keep', **dead())
    machine('busy')
    record('busy', **this_process())
    assert run('gc', '--dry-run', '--json') == 0
    would = {entry['name']: entry['reason']
             for entry in json.loads(capsys.readouterr().out)['cleared']}
    assert would == {'old': 'past its lifetime', 'gone': 'gone at its provider',
                     'kept': 'its launch is gone'}
    assert len(Memory.machines) == 3
    assert run('gc') == 0
    assert sorted(Memory.machines) == ['id-busy', 'id-kept']
    assert not Store().exists('gone')
    kept = Store().load('kept')
    assert kept.launch == '' and kept.machine_id == 'id-kept'
    assert Store().load('busy').launch == 'abc123'
    capsys.readouterr()
    assert run('gc') == 0
    assert capsys.readouterr().out == 'nothing to clear\n'


def test_gc_deletes_machines_in_parallel(monkeypatch: pytest.MonkeyPatch) -> None:
    together, destroy = threading.Barrier(3, timeout=60), Memory.destroy

    def slow(self: Memory, machine_id: str) -> None:
        together.wait()
        destroy(self, machine_id)

    monkeypatch.setattr(Memory, 'destroy', slow)
    for name in 'abc':
        machine(name)
        record(name, **dead())
    assert run('gc') == 0
    assert not Memory.machines and not Store().machines()


def test_gc_fails_if_a_provider_does_not_answer(
    capsys: pytest.CaptureFixture[str],
) -> None:
    record('a', provider='nosdk', **dead())
    record('busy', provider='nosdk', **this_process())
    assert run('gc') == 1
    assert capsys.readouterr().out == \
        "could not clear machine a: the provider 'nosdk' can't be asked\n"
    assert Store().exists('a')


@pytest.mark.parametrize('method', ['__init__', 'configured', 'find'])
def test_defect_of_a_provider_hides_no_other(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], method: str,
) -> None:
    def fail(*_: object) -> None:
        raise KeyError('oops')

    monkeypatch.setattr(Untagged, method, fail)
    machine('a')
    record('a', **dead())
    machine('b')
    assert run('delete', 'b', '-y') == 0 and run('gc') == 0
    assert not Memory.machines
    assert method == 'configured' or "untagged: KeyError: 'oops'\n" in capsys.readouterr().err


def test_delete_leaves_a_computer_of_another_robot_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Agent(FakeStream):
        def write(self, data: bytes) -> None:
            for line in data.splitlines():
                asked.append(json.loads(line)['command'])
                self.say(json.dumps(recorded_agent.answer(
                    'status', id=json.loads(line)['id'], launch='theirs')).encode() + b'\n')

    asked: list[str] = []
    shell = FakeShell(streams=[Agent()], handlers={'test': lambda c: Result(0, '', '')})
    lab(monkeypatch, shell)
    assert run('delete', 'lab', '--yes') == 0
    assert asked == ['status'] and [c.argv[0] for c in shell.commands] == ['test']


def test_delete_does_not_wait_for_an_agent_that_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """It took its program along: a client would try for seconds to run it."""
    ran: list[str] = []

    def program(status: int) -> Any:
        return lambda c: ran.append(' '.join(c.argv)) or Result(status, '', '')

    shell = FakeShell(handlers={'test': program(1), 'sh': program(0)})
    lab(monkeypatch, shell, made=(Made(undo.WATCHDOG), Made(undo.NODES)))
    assert run('delete', 'lab', '--yes') == 0
    assert ran.count('test -e /run/fogros2/lab/agent.py') == 2 and len(ran) == 3
    assert shell.opened == [] and shell.closed == 1


@pytest.mark.parametrize('fails', [False, True])
def test_delete_undoes_what_a_launch_has_made_on_a_host(
    monkeypatch: pytest.MonkeyPatch, fails: bool,
) -> None:
    """In the reverse order, by the commands of the launch's own end."""
    shell = FakeShell(handlers={
        'test': lambda c: Result(1, '', ''),
        'sh': lambda c: Result(int(fails and 'containers' in c.what), '', 'no')})
    lab(monkeypatch, shell, last='abc123', vpn=LAB_VPN, on_exit='keep', made=tuple(
        map(Made, (undo.WATCHDOG, undo.VPN, 'containers', undo.NODES))))
    assert run('delete', 'lab', '--yes') == int(fails)
    assert [c.what for c in shell.commands if c.argv[0] != 'test'] == [
        'remove its containers', 'take the VPN interface fogabc123m0 down', 'remove the agent']
    assert shell.commands[-1].argv[4:] == (
        '/run/fogros2/lab', 'abc123', '/run/fogros2/lab/start-abc123.json')
    down, = (c for c in shell.commands if 'VPN' in c.what)
    assert down == next(WireGuard().down(LAB_VPN)), 'not left to guests'
    assert Store().exists('lab') == fails


@pytest.mark.parametrize(('words', 'answers', 'forgotten'), [
    ((), True, True), ((), False, False), (('--force',), False, True)])
def test_delete_asks_the_provider_where_a_host_is(
    monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], answers: bool, forgotten: bool,
) -> None:
    shell = FakeShell(handlers={
        'test': lambda c: Result(1, '', ''), 'sh': lambda c: Result(0, '', '')})
    lab(monkeypatch, shell, endpoint=None, made=(Made(undo.WATCHDOG),))
    if not answers:
        machine('lab', provider='untagged', owned=False, endpoint=None, state=MachineState.STOPPED)
    assert run('delete', 'lab', '--yes', *words) == int(not forgotten)
    assert any(c.what == 'remove the agent' for c in shell.commands) == answers
    assert Store().exists('lab') != forgotten


def test_force_forgets_what_a_removed_feature_has_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    shell = FakeShell(handlers={
        'test': lambda c: Result(1, '', ''), 'sh': lambda c: Result(0, '', '')})
    lab(monkeypatch, shell, made=(Made(undo.WATCHDOG), Made('shelf')))
    assert run('delete', 'lab', '--yes') == 1
    assert 'install the plugin again' in capsys.readouterr().err and Store().exists('lab')
    assert run('delete', 'lab', '--yes', '--force') == 0 and not Store().exists('lab')
    assert shell.commands[-1].what == 'remove the agent'  # the others are undone


def test_gc_closes_the_ports_of_a_kept_machines_launch(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    closed: list[tuple[str, int, tuple[str, ...]]] = []
    monkeypatch.setattr(Memory, 'capabilities', Capabilities(firewall=True))
    monkeypatch.setattr(Memory, 'allow', lambda self, *what: closed.append(what))
    machine('a')
    ports = Made(undo.SSH_PORT, 2222), Made(undo.OPEN_PORT, 8766)
    record('a', on_exit='keep', notes={'monitor_open': '198.51.100.7:8766'},
           made=(*ports, Made(undo.NODES)), **dead())
    assert run('gc') == 0
    assert capsys.readouterr().out == 'cleared leftovers of a: its launch is gone\n'
    assert closed == [('id-a', 8766, ()), ('id-a', 2222, ())]
    after = Store().load('a')
    assert (after.launch, after.notes, after.made) == ('', {}, (Made(undo.NODES),))
    # of a copied state folder: another robot's launch may use the port
    machine('a', robot='other-1')
    record('a', on_exit='keep', made=ports, **dead())
    assert run('gc') == 0 and run('gc') == 0
    assert len(closed) == 2


def test_gc_tries_ports_again_that_could_not_be_closed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(Memory, 'allow', Mock(side_effect=[ProviderError('busy'), None]))
    machine('a')
    record('a', on_exit='keep', made=(Made(undo.SSH_PORT, 22),), **dead())
    folder = Store().launch_folder('abc123')
    assert run('gc') == 1 and 'busy' in capsys.readouterr().out
    after = Store().load('a')
    assert (after.launch, after.made) == ('', (Made(undo.SSH_PORT, 22),))
    assert not folder.exists(), 'nothing else waits for the port'
    assert run('gc') == 0 and Store().load('a').made == ()
    assert 'leftovers of a: its launch could not close a port' in capsys.readouterr().out
    assert run('gc') == 0 and 'nothing to clear' in capsys.readouterr().out


def test_delete_ends_what_guests_have_kept_on_a_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """The launch has left it to them at its own end."""
    shell = FakeShell(handlers={
        'test': lambda c: Result(1, '', ''), 'sh': lambda c: Result(0, '', '')})
    lab(monkeypatch, shell, agent='', vpn=LAB_VPN, on_exit='keep', launch='',
        made=(Made(undo.VPN),))
    assert run('delete', 'lab', '--yes') == 0
    assert next(WireGuard().down(LAB_VPN)) in shell.commands


def test_lifetime_of_a_reused_machine_starts_again() -> None:
    made = machine('a', expires=NOW - 3600)
    entry = Entry('a', 'memory', made, record('a', on_exit='keep', launch='', armed=NOW - 60))
    assert entry.expires == NOW - 60 + entry.record.spec.lifetime
    assert endings.why_end(entry, NOW, 7 * 86400.0) == ''
    assert 'lifetime' in endings.why_end(
        dataclasses.replace(entry, record=None), NOW, 7 * 86400.0)


def test_machine_that_a_search_omits_is_not_gone() -> None:
    """The search was in another region, say."""
    found = machine('a')
    Memory.machines['id-a'] = dataclasses.replace(found, tags={})
    record('a', **dead())
    assert [entry.state for entry in machines.survey(lambda text: None, name='a')] == [
        'running (launch gone)']


def test_container_without_an_engine_on_path_is_not_gone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    instead(monkeypatch, 'fogros2.provider', {'container': ContainerProvider})
    monkeypatch.setattr(process, 'which', lambda program: None)
    assert run('list') == 0 and capsys.readouterr() == ('no machines\n', '')
    record('a', None, provider='container', **dead())
    assert run('list') == 0
    said = capsys.readouterr()
    assert ' unknown ' in said.out and 'neither podman nor docker found' in said.err
    assert run('gc') == 1 and Store().exists('a')


def test_leftover_launch_folders_are_found_by_their_process() -> None:
    store = Store()
    rebooted = {**this_process(), 'boot': 'another'}
    for name, about in (('aaaaaa', this_process()), ('bbbbbb', dead()), ('cccccc', None),
                        ('eeeeee', rebooted)):
        folder = store.launch_folder(name)
        if about is not None:
            (folder / 'process.json').write_text(json.dumps(about))
    record('a', launch='dddddd', **dead())
    store.launch_folder('dddddd')
    assert [left.name for left in endings.leftovers(store)] == ['bbbbbb', 'eeeeee']
    later = time.time() + endings.FOLDER_AGE + 60
    assert [left.name for left in endings.leftovers(store, later)] == [
        'bbbbbb', 'cccccc', 'eeeeee']


def test_env_lets_a_terminal_join(capsys: pytest.CaptureFixture[str],
                                  monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv('RMW_IMPLEMENTATION', raising=False)
    monkeypatch.setenv('CYCLONEDDS_URI', '<a b="c\'d"/>')
    machine('a')
    record('a', **this_process())
    assert 'no launch is running' in str(run('env', 'a'))
    path = Store().launch_folder('abc123') / 'dds.xml'
    path.write_text('<x/>')
    path.with_name('domain').write_text('42')
    path.with_name('rmw').write_text('rmw_cyclonedds_cpp')
    assert run('env', 'a') == 0
    said = capsys.readouterr().out
    names = '"$RMW_IMPLEMENTATION" "$CYCLONEDDS_URI" "$ROS_DOMAIN_ID"'
    shown = subprocess.run(['sh', '-c', f'{said}\nprintf "%s\\n" {names}'],
                           capture_output=True, text=True, check=True).stdout.splitlines()
    assert shown == ['rmw_cyclonedds_cpp', f'<a b="c\'d"/>,file://{path}', '42']
    assert run('env', 'a', '--json') == 0
    assert json.loads(capsys.readouterr().out)['variables'][
        'RMW_IMPLEMENTATION'] == 'rmw_cyclonedds_cpp'
    # ROS 2's own ros2 has a daemon, which gets a port of this launch
    found = importlib.util.find_spec('os')
    monkeypatch.setattr(ros2_daemon, 'find_spec', lambda name: found)
    assert run('env', 'a') == 0
    shown = subprocess.run(['sh', '-c', f'{capsys.readouterr().out}\ncommand -v ros2'],
                           capture_output=True, text=True, check=True).stdout.strip()
    assert shown == str(path.parent / 'bin' / 'ros2')
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp')
    assert 'this terminal rmw_fastrtps_cpp' in str(run('env', 'a'))
    record('a', **dead())
    assert 'no launch is running' in str(run('env', 'a'))


@pytest.fixture
def joined(monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a launch that runs with the machine 'a'."""
    monkeypatch.delenv('RMW_IMPLEMENTATION', raising=False)
    machine('a')
    record('a', **this_process())
    folder = Store().launch_folder('abc123')
    for name, text in (('rmw', 'rmw_cyclonedds_cpp'), ('domain', '42'), ('dds.xml', '<x/>')):
        (folder / name).write_text(text)
    return folder


def test_env_refuses_a_terminal_that_would_see_nothing(
        joined: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (joined / 'rmw').write_text('rmw_fastrtps_cpp')
    assert run('env', 'a') == 0
    monkeypatch.setenv('ROS_DISCOVERY_SERVER', '127.0.0.1:11811')
    assert 'ROS_DISCOVERY_SERVER makes nodes use only a server' in str(run('env', 'a'))


def become(*words: str, stdin: Path = Path(os.devnull)) -> int:
    """Run the verb 'shell' in another process, and return the status of what it becomes."""
    child = os.fork()
    if child == 0:
        try:
            os.dup2(os.open(stdin, os.O_RDONLY), 0)
            run('shell', 'a', *words)
        finally:
            os._exit(99)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.parametrize('daemon', [False, True])
def test_shell_becomes_a_command_in_the_launch(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, joined: Path, daemon: bool,
) -> None:
    found = importlib.util.find_spec('os' if daemon else 'no_such_module')
    monkeypatch.setattr(ros2_daemon, 'find_spec', lambda name: found)
    script = 'echo "$ROS_DOMAIN_ID $RMW_IMPLEMENTATION"; command -v ros2; exit 5'
    assert become('--', 'sh', '-c', script) == 5
    first, where = capfd.readouterr().out.splitlines()
    assert first == '42 rmw_cyclonedds_cpp'
    # that of all terminals of the launch
    assert (where == str(joined / 'bin' / 'ros2')) is daemon
    assert "'no-such-program' can not be run" in str(run('shell', 'a', '--', 'no-such-program'))
    assert signal.getsignal(signal.SIGPIPE) is signal.SIG_IGN  # as Python has it
    assert become('--', 'sh', '-c', 'kill -KILL $$') == -9
    # a program ends by a pipe without a reader, as it does without us
    assert become('--', 'sh', '-c', 'kill -PIPE $$') == -13


def test_shell_becomes_the_users_shell(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, joined: Path,
    tmp_path: Path,
) -> None:
    shell = tmp_path / 'fish'
    shell.write_text('#!/bin/sh\necho "$0 $# $ROS_DOMAIN_ID"\n')
    shell.chmod(0o755)
    monkeypatch.setenv('SHELL', str(shell))
    assert become() == 0
    assert capfd.readouterr().out == f'{shell} 0 42\n'
    # bash reads .bashrc, and what that sets of ours comes before
    home = tmp_path / 'home'
    home.mkdir()
    (home / '.bashrc').write_text('export ROS_DOMAIN_ID=7 MINE=yes\n')
    monkeypatch.setenv('HOME', str(home))
    monkeypatch.setenv('SHELL', '/bin/bash')
    typed = tmp_path / 'typed'
    typed.write_text('echo "$MINE $ROS_DOMAIN_ID $PS1"; exit 4\n')
    assert become(stdin=typed) == 4
    assert capfd.readouterr().out.startswith('yes 42 (a) ')


@pytest.mark.parametrize(('seconds', 'text'), [
    (None, '-'), (-1, 'over'), (0, '0 s'), (119, '119 s'), (120, '2 min'), (7199, '2 h 00 min'),
    (3600 * 30 + 300, '30 h 05 min'), (86400 * 3 + 7200, '3 d 2 h')])
def test_durations_have_at_most_two_units(seconds: Optional[float], text: str) -> None:
    assert table.duration(seconds) == text


def test_sizes_and_costs_have_units() -> None:
    assert [report.size(n) for n in (0, 999, 1000, 1.5e9, 3e13)] == [
        '0 B', '999 B', '1.0 kB', '1.5 GB', '30.0 TB']
    assert table.cost(None) == '-' and table.cost(Decimal('1.5')) == '$1.5000'


def test_help_imports_no_core(tmp_path: Path) -> None:
    # beside what ros2cli loads for a command of its own
    code = ('import sys\nfrom ros2cli.cli import main\n'
            "for words in (['daemon'], ['fog'], *(['fog', verb] for verb in ("
            "    'bugreport', 'connect', 'dashboard', 'delete', 'doctor', 'env', 'gc', 'image',"
            "    'list', 'logs', 'plan', 'price', 'regions', 'shell', 'ssh-config', 'status',"
            "    'wait'))):\n"
            # commands with verbs of their own read them there, whatever main() is given
            "    sys.argv = ['ros2', *words, '-h']\n"
            '    try:\n        main()\n    except SystemExit:\n        pass\n'
            "    if words == ['daemon']:\n        before = set(sys.modules)\n"
            "print([m for m in set(sys.modules) - before if m.split('.')[0] in "
            "('paramiko', 'boto3', 'botocore', 'kubernetes', 'requests', 'yaml')"
            " or m in ('fogros2.deploy', 'fogros2.provider')], file=sys.stderr)")
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          cwd=tmp_path, check=True)
    assert done.stderr.splitlines()[-1] == '[]'


def test_list_loads_no_cloud_that_is_not_set_up(tmp_path: Path) -> None:
    code = ('import argparse, sys\nfrom ros2fog_cli.verb.list import ListVerb\n'
            'ListVerb().main(args=argparse.Namespace(region=None, json=False))\n'
            'print([name for name in sys.modules if name.startswith(("boto3", "cryptography", '
            '"google", "paramiko", "urllib.request", "fogros2.deploy", "fogros2.provider.vm"))])')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          cwd=tmp_path, check=True,
                          env={'PATH': str(tmp_path), 'HOME': str(tmp_path), **{
                              name: os.environ[name] for name in ('PYTHONPATH', 'LD_LIBRARY_PATH')
                              if name in os.environ}})
    assert done.stdout == 'no machines\n[]\n'


def test_record_stays_until_the_vpn_interface_is_gone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    machine('a')
    record('a', **dead())
    monkeypatch.setattr(endings, 'clear', Mock(side_effect=[ProviderError('sudo refuses'), None]))
    assert run('delete', 'a', '--yes') == 1 and 'sudo refuses' in capsys.readouterr().err
    assert Store().exists('a')
    assert run('delete', 'a', '--yes') == 0 and not Store().exists('a')
