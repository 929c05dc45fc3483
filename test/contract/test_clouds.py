# SPDX-License-Identifier: Apache-2.0
"""What holds for every cloud of virtual machines, against their simulations in this process."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import dataclasses
import subprocess
import sys

import pytest

from fogros2.errors import NameTaken, PrerequisiteError, ProviderError, Unsupported
from fogros2.model import MachineSpec
from fogros2.provider import TAG_ON_EXIT
from fogros2.waiting import wait_until
from fogros2_features.volumes.keepers import volume_keeper
from fogros2_testing import request_for, VmContract
from fogros2_testing.provider_contract import PUBLIC_KEY
from rigs.clouds_in_memory import MEMORIES

#: Those that make a machine; ``VmContract`` loses the answers to them.
CREATIONS = ('RunInstances', 'virtualmachines', 'instances.insert')
STEPS = [(name, step, how) for name, memory in MEMORIES.items() for step, how in memory.steps
         if how != 'lost' or step not in CREATIONS]


def served(name, request, monkeypatch):
    return MEMORIES[name](request.getfixturevalue(MEMORIES[name].fixture), monkeypatch)


@pytest.fixture(params=MEMORIES)
def memory(request, monkeypatch):
    return served(request.param, request, monkeypatch)


class TestClouds(VmContract):
    @pytest.fixture(autouse=True)
    def _memory(self, memory):
        self.memory = memory
        memory.open_catalogue()
        self.billed_when_off, self.elsewhere = memory.billed_when_off, {'regions': [memory.away]}

    def make(self):
        return self.memory.provider(), dict(self.memory.options)

    def another(self, provider, spec):
        return self.memory.provider()  # Moto refuses to terminate a machine twice

    def left(self):
        return self.memory.left()

    def user_data(self, machine_id):
        return self.memory.user_data(machine_id)

    def fault(self, how, times):
        return self.memory.fault(how, times)


def wait_free(provider):
    wait_until(lambda: not [one for one in volume_keeper(provider).volumes() if one.user],
               timeout=30.0, what='the volume to be free')


def with_volume(memory, name, **options):
    spec = MachineSpec(name, memory.name, {**memory.options, **options})
    request = dataclasses.replace(request_for(spec), with_volumes={'models': ('/data', 60)})
    provider = memory.provider()
    machine_id = provider.create(spec, request)
    provider.reachable(machine_id, name=name, timeout=30.0)
    return machine_id, volume_keeper(provider).attach(machine_id, 'models', 60)


def test_volume_leads_the_next_machine_to_its_zone(memory):
    provider = memory.provider()
    keeper = volume_keeper(provider)
    one, attached = with_volume(memory, 'one')
    assert attached.devices and keeper.attach(one, 'models', 60) == attached
    (volume,) = keeper.volumes()
    assert (volume.name, volume.size_gb, volume.user in one) == ('models', 60, True)
    assert volume.cost_per_month > 4
    # another launch, and the verb
    with pytest.raises(NameTaken, match="'models' .* is in use by"):
        with_volume(memory, 'two')
    with pytest.raises(NameTaken, match="'models' .* is in use by"):
        keeper.delete_volume(volume.id)
    provider.destroy(one)
    wait_free(provider)
    # of two regions, the volume's is taken
    two, _ = with_volume(memory, 'two', region=memory.away,
                         regions=[volume.region, volume.id.split(':')[1].split('/')[0]][1:])
    assert [(one.id, one.user in two) for one in keeper.volumes()] == [(volume.id, True)]
    keeper.detach(two, 'models')
    keeper.detach(two, 'models')
    wait_free(provider)
    provider.destroy(two)
    assert provider.tidy() == []
    keeper.delete_volume(volume.id)
    wait_until(lambda: not list(keeper.volumes()), timeout=30.0, what='no volume')
    keeper.delete_volume(volume.id)


def test_two_launches_that_make_a_volume_at_once_keep_one(memory):
    provider = memory.provider()
    spec = MachineSpec('two', memory.name, dict(memory.options))
    two = provider.create(spec, request_for(spec))
    provider.reachable(two, name='two', timeout=30.0)
    one, _ = with_volume(memory, 'one')
    adapter = provider.cloud
    list_disks, delete_disk = type(adapter).disks, type(adapter).delete_disk
    # the first look came before the other launch's volume, others while it is made
    looks = iter([lambda disks: [], *2 * [lambda disks: [
        dataclasses.replace(disk, ready=False) for disk in disks]]])

    def delete(own, disk):
        assert not [*looks]
        delete_disk(own, disk)

    memory.patch.setattr(type(adapter), 'disks', lambda own, region, name='': next(
        looks, list)(list_disks(own, region, name)))
    memory.patch.setattr(type(adapter), 'delete_disk', delete)
    with pytest.raises(NameTaken, match='is in use by'):
        volume_keeper(provider).attach(two, 'models', 60)
    memory.patch.setattr(type(adapter), 'disks', list_disks)
    assert [volume.user in one for volume in volume_keeper(provider).volumes()] == [True]


def create(memory, name='planner', **options):
    spec = MachineSpec(name, memory.name, {**memory.options, **options})
    request = request_for(spec, **{TAG_ON_EXIT: 'delete'})
    return memory.provider().create(spec, request), request.token


def gone(memory):
    wait_until(lambda: not memory.left(), timeout=60.0, what='nothing to be left')


@pytest.mark.parametrize(('name', 'step', 'how'), STEPS)
def test_fault_at_each_step_leaves_nothing(request, monkeypatch, name, step, how):
    memory = served(name, request, monkeypatch)
    memory.fail(step, how)
    with pytest.raises(ProviderError) as caught:
        create(memory)
    assert caught.value.undo_failures == ()
    assert caught.value.refused or how == 'lost'
    gone(memory)


def test_full_quota_leads_to_the_next_type(memory):
    with memory.fault('quota', 1):
        machine, _ = create(memory, **memory.more)
    (further,) = memory.more.values()
    assert memory.provider().describe(machine).kind == further[0]
    memory.provider().destroy(machine)
    gone(memory)


def test_machines_at_once_are_as_many(memory):
    with ThreadPoolExecutor(3) as pool:
        made = list(pool.map(lambda number: create(memory, f'm{number}')[0], range(3)))
        assert {machine.id for machine in memory.provider().find({})} == set(made)
        assert len(set(made)) == 3
        list(pool.map(memory.provider().destroy, made))
    gone(memory)


def test_spot_machine_can_not_be_stopped(memory):
    machine, _ = create(memory, spot=True)
    found = memory.provider().describe(machine)
    assert found.kind.endswith(' spot')
    assert memory.provider().capabilities_of(found).preemption_notice
    with pytest.raises(Unsupported, match='spot'):
        memory.provider().stop(machine)
    memory.provider().destroy(machine)
    gone(memory)


def test_launch_takes_few_requests(memory):
    memory.hurry()
    machine, _ = create(memory)
    provider = memory.provider()
    provider.reachable(machine, name='planner', timeout=60.0)
    provider.pin(machine, PUBLIC_KEY)
    provider.allow(machine, 22, [])
    provider.destroy(machine)
    gone(memory)
    assert memory.calls() <= memory.launching


def test_lost_connection_ends_no_wait_and_no_request(memory):
    provider = memory.provider()
    machine, _ = create(memory)
    provider.describe(machine)  # the report of the creation is used once
    with memory.unconnected(2) as looks:
        provider.reachable(machine, name='planner', timeout=60.0)
    assert len(looks) == 2
    with memory.unconnected(1000) as failed, pytest.raises(PrerequisiteError, match='not answer'):
        memory.provider().destroy(machine)
    assert 1 < len(failed) < 1000, 'it is an error if no request can be sent'
    with memory.unconnected(2, after=memory.deletion) as looks, memory.unconnected(3) as failed:
        memory.provider().destroy(machine)
    assert len(failed) == 3, 'a request that could not be sent is made again'
    assert len(looks) == 2
    gone(memory)


def test_launch_that_waits_for_the_boot_changes_no_rule(memory):
    provider, spec = memory.provider(), MachineSpec('planner', memory.name, memory.options)
    machine = provider.create(spec, request_for(spec))
    here, elsewhere = ['198.51.100.7/32'], ['203.0.113.9/32']
    before = memory.calls()
    provider.allow(machine, 22, here)
    assert memory.calls() == before
    provider.allow(machine, 22, elsewhere)
    changed = memory.calls()
    provider.allow(machine, 22, here)
    assert before < changed < memory.calls()
    provider.destroy(machine)
    gone(memory)


def test_list_of_all_regions_takes_few_requests(memory):
    here, there = create(memory)[0], create(memory, 'mapper', region=memory.away)[0]
    before = memory.calls()
    assert {machine.id for machine in memory.provider().find({})} == {here, there}
    assert memory.calls() - before <= memory.listing
    provider = memory.provider()
    provider.search_in([memory.away])
    assert [machine.id for machine in provider.find({})] == [there]


def test_clouds_are_described_without_their_libraries():
    program = ('import sys; from fogros2.plugin_system import load\n'
               'from fogros2_features.prices import clouds\n'
               f'for name in {[*MEMORIES]}:\n'
               '    p = load("fogros2.provider", name); p(); p.configured(); p.region_names()\n'
               'names = {module.split(".")[0] for module in sys.modules}\n'
               'print(clouds.clouds()[1], names & {"azure", "boto3", "botocore", "google", '
               '"googleapiclient", "kubernetes", "msal", "requests"})')
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True,
                          timeout=60, env={'HOME': '/nowhere', 'PYTHONPATH': ':'.join(sys.path)})
    assert done.stdout == "['aws', 'azure', 'gcp'] set()\n", done.stderr


def test_leftovers_of_a_dead_launch_go_at_once(memory):
    _, token = create(memory)
    memory.vanish()
    assert memory.provider().tidy() == []  # a new attempt may still get its machine
    (said,) = memory.provider().tidy([token])
    assert 'planner' in said
    gone(memory)


def test_machine_detaches_no_volume_of_another(memory):
    """Such as a kept one, whose launch found the volume in use."""
    one, _ = with_volume(memory, 'one')
    two, _ = create(memory, 'two')
    keeper = volume_keeper(memory.provider())
    keeper.detach(two, 'models')
    assert [volume.user in one for volume in keeper.volumes()] == [True]
