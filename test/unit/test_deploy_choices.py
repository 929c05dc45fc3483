# SPDX-License-Identifier: Apache-2.0
"""Tests of fogros2.deploy where a provider chooses, costs money, or gets dependencies."""

from __future__ import annotations

import dataclasses
from decimal import Decimal
import time
from types import SimpleNamespace

import pytest

from fogros2.deploy import choosing, Launch
from fogros2.deploy import launch as launches
from fogros2.deploy.context import Context
from fogros2.deploy.running import RunningMachine
from fogros2.deploy.steps import creating
from fogros2.deploy.steps.creating import Creation
from fogros2.errors import (
    AgentError,
    ConfigurationError,
    NameTaken,
    ProviderError,
    WorkspaceError,
)
from fogros2.feature import Cost
from fogros2.model import MachineSpec
from fogros2.report import StepDone, StepFailed, StepStarted, Warned
from fogros2.store import Store
from fogros2_testing.fakes import FakeProvider, FakeVpn
from fogros2_testing.plugins import instead
from rigs.pip_site import distribution, package

SPEC = MachineSpec('planner', 'fake', {'size': 'cheapest'})
PRICES = {'large': Decimal(2), 'small': Decimal('0.5')}


@pytest.fixture
def provider(monkeypatch):
    fake = FakeProvider(prices=PRICES)
    instead(monkeypatch, 'fogros2.provider', {'fake': lambda: fake})
    monkeypatch.setattr(launches, 'check_robot', lambda: None)
    return fake


@pytest.fixture
def events():
    return []


@pytest.fixture
def launch(tmp_path, monkeypatch, events):
    instead(monkeypatch, 'fogros2.vpn', {'wireguard': FakeVpn})
    monkeypatch.setattr('fogros2.shell.warm', lambda kind: None)
    return Launch(store=Store(tmp_path), environment={}, report=events.append)


def create(launch, spec=SPEC):
    """Take a machine through its first steps; returns what they share."""
    context = launch.context(spec)
    mine = RunningMachine(context, spec)
    Creation(context, mine).run()
    return mine


def test_error_of_checks_and_choices_names_the_machine(launch, provider):
    for step in ('check', 'resolve'):
        provider.failures[step] = ProviderError('the region has no such type')
        with pytest.raises(ProviderError, match='^planner: the region has no such type'):
            launch.prepare([SPEC])


def test_choices_are_made_once_and_shown_with_the_price(
        launch, provider, events):
    launch.prepare([SPEC])
    assert 'create' not in provider.calls
    assert events == [
        StepStarted('planner', 'choices'),
        dataclasses.replace(events[1], machine='planner', step='choices',
                            detail='size small, $0.5000 an hour')]
    mine = create(launch)
    assert provider.calls.count('resolve') == 1
    assert mine.spec.options == {'size': 'small'}
    assert launch.store.load('planner').spec == mine.spec
    done = [event for event in events if isinstance(event, StepDone)][-1]
    assert done.step == 'machine' and '$0.5000 an hour' in done.detail


def test_a_budget_limits_the_lifetime_by_the_price(launch, provider, monkeypatch):
    spec = dataclasses.replace(SPEC, features={'budget': {'budget': '2 USD'}})
    # a minute is kept back
    assert create(launch, spec).spec.lifetime == pytest.approx(4 * 3600.0 - 60.0, abs=1.0)
    assert launch.store.load('planner').spec.lifetime == pytest.approx(14340.0, abs=1.0)
    # what the provider confirms counts
    describe = provider.describe
    monkeypatch.setattr(provider, 'describe', lambda machine_id: dataclasses.replace(
        describe(machine_id), cost_per_hour=Decimal(4)))
    other = dataclasses.replace(spec, name='other', lifetime=1e6)
    assert create(launch, other).spec.lifetime == pytest.approx(1740.0, abs=1.0)


def test_machines_of_a_launch_end_when_all_have_spent_its_budget(launch, provider):
    first, second = (dataclasses.replace(SPEC, name=name, lifetime=1e6) for name in ('a', 'b'))
    # one machine has the keyword; both count before any is created
    first = dataclasses.replace(first, features={'budget': {'launch_budget': '0.2 USD'}})
    launch.prepare([first, second])
    for spec in (first, second):
        assert create(launch, spec).spec.lifetime == pytest.approx(660.0, abs=1.0)
    late = dataclasses.replace(second, name='late', options={'size': 'large'})
    with pytest.raises(ConfigurationError, match=r'the launch has \$0.20 .* pays for 180 s'):
        launch.prepare([late])
    assert provider.calls.count('create') == 2


def test_machines_with_one_volume_are_refused_before_creation(launch, monkeypatch):
    class Keeping(FakeProvider):
        capabilities = FakeProvider.can(keeps_volumes=True)

    instead(monkeypatch, 'fogros2.provider', {'fake': Keeping})
    first, second = (MachineSpec(name, 'fake', features={
        'volumes': {'volumes': {'maps': '/data'}}}) for name in ('a', 'b'))
    launch.prepare([first])
    with pytest.raises(ConfigurationError, match="'a' and 'b' have one volume 'maps'"):
        launch.prepare([second])
    assert 'create' not in launch.provider('fake').calls
    launch._choices.end('a')
    launch.prepare([second])


def test_machine_that_runs_gets_less_time_when_another_costs(launch, provider):
    spec = dataclasses.replace(SPEC, lifetime=1e6, features={'budget': {'launch_budget': '1'}})
    first = create(launch, spec)
    first.restart_lifetime(first.spec.lifetime)
    requests, answers = [], [AgentError('silent')]

    def request(command, *, lifetime=None, **arguments):
        if command == 'configure':
            requests.append(lifetime)
            if answers:
                raise answers.pop()

    first.agent = SimpleNamespace(request=request)
    first.shorten()
    assert requests == []
    create(launch, dataclasses.replace(spec, name='other', features={}))
    # the launch creates no other machine before the agent knows
    with pytest.raises(AgentError):
        first.shorten()
    first.shorten()
    first.shorten()
    assert requests == pytest.approx([3540.0, 3540.0], abs=2.0)
    record = launch.store.load('planner')
    assert record.armed + record.spec.lifetime == pytest.approx(time.time() + 3540.0, abs=2.0)
    create(launch, dataclasses.replace(spec, name='third', features={}))
    first.end('nobody uses it')
    first.shorten()
    assert len(requests) == 2


@pytest.mark.parametrize('over', [False, True])
def test_end_of_an_idle_machine_is_tried_again(launch, provider, events, monkeypatch, over):
    monkeypatch.setattr(creating, 'RETRY', 0.01)
    mine = create(launch)
    mine.enter('up')
    provider.failures['destroy'] = ProviderError('the token has expired')
    if over:
        launch.cancel.set()
    assert mine.end('nobody uses it') is not over
    assert [cost.ended for cost in launch.costs()] == [not over]
    assert len(launch._failures) == over and len(provider.machines) == over
    assert [event.text for event in events if isinstance(event, Warned)] == [
        "'planner' has not ended yet: the token has expired"] * (not over)


def test_compiled_workspace_is_refused_before_creation(launch, provider, tmp_path, monkeypatch):
    prefix = tmp_path / 'ws/install/arm'
    (prefix / 'share/ament_index/resource_index/packages').mkdir(parents=True)
    (prefix / 'share/ament_index/resource_index/packages/arm').touch()
    library = prefix / 'lib/libarm.so'
    library.parent.mkdir()
    library.write_bytes(b'\x7fELF' + bytes(14) + b'\x3e\0')
    spec = dataclasses.replace(SPEC, workspace=str(tmp_path / 'ws'))
    launch.prepare([spec])  # where only the machine knows its processor
    answers, asked = ['x86_64', 'aarch64'], []

    def architecture(spec):
        asked.append(spec.options)
        return answers.pop(0)

    monkeypatch.setattr(provider, 'architecture', architecture)
    launch.prepare([spec])
    with pytest.raises(WorkspaceError, match='libarm.so is built for x86_64'):
        launch.prepare([spec])
    assert asked == [{'size': 'small'}] * 2  # of the machine that was chosen
    assert 'create' not in provider.calls


def test_undeclared_pip_packages_are_reported_before_creation(
        launch, provider, events, tmp_path, monkeypatch):
    distribution(tmp_path, 'fogt-one', 'fogt_one.py')
    monkeypatch.syspath_prepend(tmp_path)
    package(tmp_path / 'ws', 'rob_tools', 'import fogt_one')
    launch.prepare([dataclasses.replace(SPEC, workspace=str(tmp_path / 'ws'))])
    (warned,) = [event for event in events if isinstance(event, Warned)]
    assert (warned.machine, warned.remedy) == (
        'planner', "add pip=['fogt-one'] to machine 'planner'")
    assert 'create' not in provider.calls


def test_launch_goes_on_where_packages_cannot_be_looked_at(
        launch, provider, events, tmp_path, monkeypatch):
    def names():
        raise ConfigurationError('not installed')

    monkeypatch.setattr('fogros2.host.wheels.names', names)
    package(tmp_path / 'ws', 'rob_tools')
    launch.prepare([dataclasses.replace(SPEC, workspace=str(tmp_path / 'ws'))])
    assert not [event for event in events if isinstance(event, Warned)]
    assert 'resolve' in provider.calls


def test_leftovers_of_a_creation_are_reported_with_its_error(
        launch, provider, events):
    error = ProviderError('no room')
    error.refused = True
    error.undo_failures = (ProviderError('the key is left'),)
    provider.failures['create'] = error
    context = launch.context(SPEC)
    mine = RunningMachine(context, SPEC)
    with pytest.raises(ProviderError, match='no room'):
        Creation(context, mine).run()
    mine.undo.close()
    assert [event.reason for event in events if isinstance(event, StepFailed)] == [
        'the key is left', 'no room']
    assert [str(failure) for failure in launch.down()] == ['the key is left']


def keep(launch, spec):
    mine = create(launch, dataclasses.replace(spec, on_exit='keep'))
    mine.enter('up')
    mine.undo.close()


def test_launch_replaces_machine_whose_id_was_not_saved(launch, provider, tmp_path):
    killed = create(launch)
    killed.save(machine_id=None, pid=1, pid_start=1)
    again = create(Launch(store=Store(tmp_path), environment={}))
    assert [machine.id for machine in provider.find({})] == [again.machine_id]
    assert again.machine_id is not None and again.life.phase == 'new'


def test_kept_machine_fits_though_today_differs(
        launch, provider, tmp_path):
    keep(launch, SPEC)
    provider.prices['tiny'] = Decimal('0.1')
    provider.calls.clear()
    again = Launch(store=Store(tmp_path), environment={})
    again.prepare([SPEC])
    mine = create(again)
    assert mine.life.phase == 'kept' and not {'resolve', 'create'} & {*provider.calls}
    # an engine takes 0.1 s for an answer
    assert provider.calls.count('describe') == 1
    assert mine.spec.options == {'size': 'small'}
    assert [(one.spec.name, one.price) for one in again.costs()] == [('planner', Decimal('0.5'))]
    mine.enter('up')
    mine.undo.close()
    assert list(provider.find({})) == []


def test_expired_machine_is_chosen_anew_before_creation(launch, provider, tmp_path):
    keep(launch, SPEC)
    provider.machines.clear()
    provider.prices['tiny'] = Decimal('0.1')
    again = Launch(store=Store(tmp_path), environment={})
    again.prepare([SPEC])
    assert [(one.spec.options, one.price) for one in again.costs()] == [
        ({'size': 'tiny'}, Decimal('0.1'))]


def test_kept_machine_gets_its_owner_before_it_starts(
        launch, provider, tmp_path, monkeypatch):
    keep(launch, SPEC)
    adopted = []
    monkeypatch.setattr(
        provider, 'adopt', lambda *words: adopted.append((list(provider.calls), *words)))
    again = Launch(store=Store(tmp_path), environment={})
    spec = dataclasses.replace(SPEC, on_exit='stop', lifetime=60.0)
    provider.calls.clear()
    # the kept one can be stopped, since who has it says so
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(adopt=True))
    mine = create(again, spec)
    (calls, machine_id, told, tags), = adopted
    assert calls == ['describe'] and machine_id == mine.machine_id
    assert told.on_exit == tags['fogros2-on-exit'] == 'stop'
    assert tags['fogros2-launch'] == again.id
    assert 0 < int(tags['fogros2-expires']) - time.time() <= 60
    mine.enter('up')
    mine.undo.close()


def test_a_machine_s_cost_runs_until_it_has_ended(launch, provider, monkeypatch):
    now = 100.0
    monkeypatch.setattr(choosing, '_clocks', lambda: (now, now))
    mine = create(launch)
    now += 60
    assert launch.costs() == [Cost(mine.spec, Decimal('0.5'), 60.0)]
    mine.undo.close()
    now += 60
    assert launch.costs() == [Cost(mine.spec, Decimal('0.5'), 60.0, ended=True)]


@pytest.mark.parametrize(('settings', 'seconds'), [
    ({'robot_timeout': 9999.0}, 3660.0), ({'robot_timeout': 120.0}, 180.0),
    ({'robot_timeout': 120.0, 'on_exit': 'keep'}, 3660.0)])
def test_machine_costs_while_the_robot_is_suspended(monkeypatch, settings, seconds):
    clocks = {time.CLOCK_BOOTTIME: 100.0, time.CLOCK_MONOTONIC: 100.0}
    monkeypatch.setattr(time, 'clock_gettime', clocks.__getitem__)
    monkeypatch.setattr(time, 'monotonic', lambda: clocks[time.CLOCK_MONOTONIC])
    choices = choosing.Choices(lambda name: None, lambda event: None)
    choices.expect(dataclasses.replace(SPEC, **settings), Decimal(1))
    choices.begin(SPEC.name)
    clocks[time.CLOCK_BOOTTIME] += 3660.0
    clocks[time.CLOCK_MONOTONIC] += 60.0
    assert [cost.seconds for cost in choices.costs()] == [seconds]
    choices.end(SPEC.name)
    assert [cost.seconds for cost in choices.costs()] == [seconds]


def test_provider_knows_what_will_be_installed(launch, provider, monkeypatch):
    requests = []
    made = provider.create
    monkeypatch.setattr(
        provider, 'create', lambda spec, request: requests.append(request) or made(spec, request))
    monkeypatch.setattr(
        'fogros2.host.bootstrap.dependencies', lambda spec, under, packages: 'a' * 16)
    monkeypatch.setattr(Context, 'underlay', lambda self, workspaces: None)
    keep(launch, SPEC)
    assert requests[0].dependencies == requests[0].tags['fogros2-dependencies'] == 'a' * 16


def test_image_of_a_kept_machine_has_what_was_added(launch, provider, tmp_path, monkeypatch):
    monkeypatch.setattr(Context, 'underlay', lambda self, workspaces: None)
    monkeypatch.setattr(
        'fogros2.host.bootstrap.dependencies', lambda spec, under, packages: ' '.join(spec.apt))
    adopted = []
    monkeypatch.setattr(provider, 'adopt', lambda machine_id, spec, tags: adopted.append(tags))
    keep(launch, SPEC)
    create(Launch(store=Store(tmp_path), environment={}),
           dataclasses.replace(SPEC, apt=('libzbar0',)))
    assert [tags['fogros2-dependencies'] for tags in adopted] == ['libzbar0']


def test_stopped_machine_costs_nothing_any_more(launch, provider, monkeypatch):
    now = 100.0
    monkeypatch.setattr(choosing, '_clocks', lambda: (now, now))
    mine = create(launch, dataclasses.replace(SPEC, on_exit='stop'))
    mine.enter('up')
    now += 60
    mine.undo.close()
    now += 60
    assert launch.costs() == [Cost(mine.spec, Decimal('0.5'), 60.0, ended=True)]


def test_machine_that_does_not_come_up_takes_no_budget(launch, provider):
    launch.prepare([SPEC])
    assert [cost.price for cost in launch.costs()] == [Decimal('0.5')]
    with launch.store.lock('planner', cancel=launch.cancel):
        with pytest.raises(NameTaken):
            launch.up(SPEC)
    assert launch.costs() == []
