# SPDX-License-Identifier: Apache-2.0
"""The Azure provider against a simulated Azure: what it asks, leaves, and does when refused."""

from __future__ import annotations

import base64
import dataclasses
from decimal import Decimal
import gzip
import json
from pathlib import Path
import re
import threading
import time
import uuid

import pytest

from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    FogError,
    PrerequisiteError,
    ProviderError,
)
from fogros2.model import CreateRequest, MachineSpec, MachineState
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.provider.azure import ending
from fogros2.provider.azure.account import Account
from fogros2.provider.azure.provider import AzureProvider
from fogros2.provider.vm.user_data import LIMIT
from fogros2.waiting import wait_until
from fogros2_features.images.keepers import image_keeper
from fogros2_features.volumes.keepers import volume_keeper
from fogros2_testing.provider_contract import PUBLIC_KEY
from rigs.azure import service
from rigs.azure.service import Fault

HOME, AWAY = 'westeurope', 'eastus'
SMALL, LARGE = 'Standard_B2als_v2', 'Standard_D2s_v5'


class Robot:
    """A provider, and what the simulated Azure has."""

    def __init__(self, azure: service.Service) -> None:
        self.azure = azure
        self.provider = AzureProvider()

    def spec(self, name: str = 'planner', **options: object) -> MachineSpec:
        return MachineSpec(
            name, 'azure', {'region': HOME, 'vm_size': SMALL, **options}, lifetime=7200.0)

    def request(self, **fields: object) -> CreateRequest:
        return dataclasses.replace(CreateRequest(
            str(uuid.uuid4()), PUBLIC_KEY, {'fogros2-expires': str(int(time.time()) + 7200)},
            51820), **fields)

    def create(self, **options: object) -> str:
        return self.provider.create(self.spec(**options), self.request())

    def reach(self, machine_id: str):
        return self.provider.reachable(machine_id, name='planner', timeout=60.0)

    def gone(self) -> None:
        """Wait until the deletions that were asked for have been carried out."""
        wait_until(lambda: not self.azure.vms() and not self.azure.groups, timeout=60.0,
                   what='everything to be deleted')

    def asked(self, kind: str = '', method: str = '') -> list[str]:
        return [call.error for call in self.azure.calls
                if kind in ('', call.service) and method in ('', call.action)]


@pytest.fixture
def robot(azure_service):
    return Robot(azure_service)


# -- the whole way ------------------------------------------------------------------------------


def test_interrupted_creation_is_taken_up_where_it_was(robot, monkeypatch):
    monkeypatch.setattr('fogros2.provider.vm.account.ATTEMPTS', 1)
    request = robot.request()
    robot.azure.faults.append(Fault('InternalServerError', 500, 'PUT', 'virtualMachines', times=0))
    # the process dies there, without its undo
    with monkeypatch.context() as patch, pytest.raises(FogError):
        patch.setattr('fogros2.provider.azure.cloud.Azure._drop', lambda *_, **__: None)
        robot.provider.create(robot.spec(), request)
    assert len(robot.azure.groups) == 1
    robot.azure.faults.clear()
    machine_id = robot.provider.create(robot.spec(), request)
    assert len(robot.azure.groups) == 1
    robot.provider.destroy(machine_id)
    assert robot.azure.groups == {}


@pytest.mark.parametrize(('rights', 'kind'), [
    (service.OPERATOR, 'roleassignments'), (service.CONTRIBUTOR, 'schedules')])
def test_machine_without_room_yet_ends_without_its_robot(robot, monkeypatch, rights, kind):
    def killed(own, name, what):
        raise ProviderError('the process dies here')

    robot.azure.rights = rights
    with monkeypatch.context() as patch, pytest.raises(ProviderError, match='dies here'):
        patch.setattr('fogros2.provider.azure.cloud.Azure._drop', lambda *_, **__: None)
        patch.setattr('fogros2.provider.azure.cloud.Azure._allocated', killed)
        robot.create()
    (vm,) = robot.azure.vms()
    assert [key for key in robot.azure.resources if f'/{kind}/' in key]


def test_schedule_refused_before_the_allocation_is_set_after_it(robot):
    robot.azure.rights = service.CONTRIBUTOR
    robot.azure.faults.append(Fault('ResourceNotFound', 404, 'PUT', 'schedules'))
    machine_id = robot.create()
    assert robot.asked('schedules', 'PUT') == ['ResourceNotFound', '']
    assert 'is billed' in robot.reach(machine_id).note
    robot.provider.destroy(machine_id)


@pytest.mark.parametrize('kind', ['networkSecurityGroups', 'virtualMachines'])
def test_group_that_is_not_known_everywhere_yet_is_waited_for(robot, kind):
    robot.azure.faults.append(Fault('ResourceGroupNotFound', 404, 'PUT', kind))
    machine_id = robot.create()
    assert robot.asked(kind.lower(), 'PUT') == ['ResourceGroupNotFound', '']
    robot.provider.destroy(machine_id)
    assert robot.azure.groups == {}


# -- undo ---------------------------------------------------------------------------------------


@pytest.mark.parametrize('step', ['resourcegroups', 'networkinterfaces', 'schedules'])
def test_launch_that_ends_during_a_step_leaves_nothing(robot, step, monkeypatch):
    robot.provider.cancel = cancel = threading.Event()
    robot.azure.rights = service.CONTRIBUTOR
    answer = robot.azure.answer

    def answered(method, target, headers, body):
        if method == 'PUT' and service.kind_of(target.partition('?')[0]) == step:
            cancel.set()
        return answer(method, target, headers, body)

    monkeypatch.setattr(robot.azure, 'answer', answered)
    try:
        machine_id = robot.create()
    except Cancelled:
        pass
    else:
        robot.provider.destroy(machine_id)  # the last step may be over
    robot.gone()


def test_group_that_is_not_ours_is_never_deleted(robot):
    machine_id = robot.create()
    name = machine_id.split('/')[1]
    for other, tags in (('robots', {}), ('copied', {'fogros2-attempt': name[8:24]}),
                        ('fogros2-mine', {'fogros2-attempt': '0' * 16})):
        robot.azure.groups[other] = {
            'id': f'/subscriptions/{service.SUBSCRIPTION}/resourceGroups/{other}', 'name': other,
            'location': HOME, 'tags': {**tags, 'fogros2-made': '1'},
            'properties': {'provisioningState': 'Succeeded'}}
    robot.provider.tidy()
    robot.provider.destroy(machine_id)
    assert set(robot.azure.groups) == {'robots', 'copied', 'fogros2-mine'}
    # a group of a machine's name, without its tags
    robot.azure.groups[name] = {**robot.azure.groups['robots'], 'name': name, 'tags': {}}
    with pytest.raises(ProviderError, match='has no tag of FogROS2'):
        robot.provider.destroy(machine_id)
    assert name in robot.azure.groups


# -- no room ------------------------------------------------------------------------------------


def test_late_lack_of_room_leads_to_the_next_size(robot):
    robot.azure.faults.append(Fault(
        'AllocationFailed', 409, 'PUT', 'virtualMachines', size=SMALL, late=True))
    machine_id = robot.create(vm_sizes=[LARGE])
    machine = robot.reach(machine_id)
    assert machine.kind == LARGE and machine.cost_per_hour == Decimal('0.096')
    wait_until(lambda: len(robot.azure.vms()) == len(robot.azure.groups) == 1, timeout=60.0,
               what='the first to be deleted')
    robot.provider.destroy(machine_id)
    assert robot.azure.groups == {}


def test_size_that_the_subscription_may_not_use_is_skipped(robot):
    robot.azure.restricted = {SMALL}
    machine_id = robot.create(vm_sizes=[LARGE])
    assert robot.provider.describe(machine_id).kind == LARGE
    robot.provider.destroy(machine_id)
    with pytest.raises(ConfigurationError, match=f'Azure has no {SMALL} in {HOME}'):
        robot.create()


def test_known_problems_are_named_before_creation(robot, monkeypatch):
    for options, words in (({'vm_size': 'Standard_X1'}, 'Azure has no Standard_X1'),
                           ({'vm_size': 'Standard_DS2_v2', 'spot': True}, 'as a spot machine'),
                           ({'image': 'a:b:c:latest'}, 'no such image')):
        with pytest.raises(FogError, match=words):
            robot.create(**options)
    robot.gone()
    monkeypatch.setenv('AZURE_SUBSCRIPTION_ID', 'another')
    with pytest.raises(PrerequisiteError, match='no such subscription'):
        robot.create()
    monkeypatch.setenv('IDENTITY_HEADER', 'wrong')
    monkeypatch.setattr('fogros2.provider.azure.cloud._USUAL', Account())  # has no token yet
    with pytest.raises(PrerequisiteError, match='az login'):
        Robot(robot.azure).create()


# -- the end ------------------------------------------------------------------------------------


def test_without_the_right_azure_ends_a_machine_at_its_lifetime(robot):
    robot.azure.rights = service.CONTRIBUTOR
    machine_id = robot.create()
    machine = robot.reach(machine_id)
    end = time.time() + 7200
    (schedule,) = [entry for key, entry in robot.azure.resources.items() if '/schedules/' in key]
    properties = schedule['properties']
    assert properties['taskType'] == 'ComputeVmShutdownTask'
    first = time.strptime(properties['dailyRecurrence']['time'], '%H%M')
    assert (first.tm_hour * 60 + first.tm_min - end // 60) % 1440 <= 3
    assert properties['targetResourceId'].endswith(machine_id.split('/')[1])
    assert 'powers itself off and is billed' in machine.note and 'at most $0.08' in machine.note
    assert 'identity' not in robot.azure.vms()[0]
    robot.azure.calls.clear()
    robot.provider.adopt(machine_id, robot.spec(), {'fogros2-expires': '1'})
    assert robot.asked('schedules', 'PUT') == ['']
    robot.provider.destroy(machine_id)


@pytest.mark.parametrize(('code', 'kind'), [
    ('AuthorizationFailed', 'roleDefinitions'), ('RoleDefinitionDoesNotExist', 'roleAssignments')])
def test_role_that_is_refused_leads_to_the_schedule(robot, monkeypatch, code, kind):
    monkeypatch.setattr(ending, 'ROLE', 0.3)
    robot.azure.faults.append(Fault(code, 403, 'PUT', kind, times=0))
    machine_id = robot.create()
    assert 'is billed' in robot.reach(machine_id).note
    robot.azure.faults.clear()
    robot.provider.destroy(machine_id)


def test_schedule_of_a_long_life_is_set_anew(robot, monkeypatch):
    robot.azure.rights = service.CONTRIBUTOR
    monkeypatch.setattr(ending, 'DAY', 0.4)
    machine_id = robot.create()
    wait_until(lambda: len(robot.asked('schedules', 'PUT')) > 2, timeout=60.0, what='two more')
    robot.provider.destroy(machine_id)
    # until the machine is gone
    wait_until(lambda: 'fog-rearm' not in [thread.name for thread in threading.enumerate()],
               timeout=60.0, what='the last one')


def test_user_data_stays_below_the_limit_of_the_clouds(robot):
    request = robot.request(agent_config={
        'machine': 'p' * 40, 'directory': '/run/fogros2', 'end_command': []})
    machine_id = robot.provider.create(robot.spec('p' * 40), request)
    (vm,) = robot.azure.vms()
    data = base64.b64decode(vm['properties']['osProfile']['customData'])
    assert len(data) < LIMIT and ending.NOTICE[-1].encode() not in gzip.decompress(data)
    assert b'identity/oauth2/token' in gzip.decompress(data)
    robot.provider.destroy(machine_id)


def test_role_is_assigned_to_the_machine_s_own_group(robot):
    machine_id = robot.create()
    (key,) = [key for key in robot.azure.resources if '/roleassignments/' in key]
    assert key.startswith(f'/subscriptions/{service.SUBSCRIPTION}/resourcegroups/'
                          f'{machine_id.split("/")[1]}/providers/')
    again = robot.provider.create(robot.spec('mapper'), robot.request())
    assert len([key for key in robot.azure.resources if '/roledefinitions/' in key]) == 1
    for one in (machine_id, again):
        robot.provider.destroy(one)


def test_role_of_the_page_has_exactly_the_actions_needed(robot):
    page = (Path(__file__).parents[2] / 'doc' / 'azure.md').read_text()
    role = json.loads(re.findall(r'```json\n(.*?)```', page, re.DOTALL)[0])
    robot.azure.rights = {'actions': role['Actions'], 'notActions': []}
    assert robot.provider.answers()
    machine_id = robot.create(vm_size='Standard_NC4as_T4_v3')
    machine = robot.reach(machine_id)
    robot.provider.pin(machine_id, PUBLIC_KEY)
    robot.provider.adopt(machine_id, robot.spec(), {'fogros2-expires': '1'})
    assert [one.id for one in robot.provider.find({})] == [machine_id]
    for sources in ([], ['198.51.100.9/32']):
        robot.provider.open_port(machine, 8766, sources)
        robot.provider.allow(machine_id, 22, sources)
    robot.azure.faults.append(Fault('Wrong', 400, 'PUT', 'galleries', late=True))
    with pytest.raises(ProviderError, match='Wrong'):
        image_keeper(robot.provider).bake(machine_id, 'planner', 'abcd')
    image_id = image_keeper(robot.provider).bake(machine_id, 'planner', 'abcd')
    wait_until(lambda: [one.state for one in image_keeper(robot.provider).images()]
               == ['available'], timeout=60.0, what='the image')
    robot.provider.stop(machine_id)
    wait_until(lambda: robot.provider.describe(machine_id).state is MachineState.STOPPED,
               timeout=60.0, what='the stop')
    robot.provider.start(machine_id)
    volume_keeper(robot.provider).attach(machine_id, 'models', 1)
    robot.provider.tidy()
    image_keeper(robot.provider).delete_image(image_id)
    robot.provider.destroy(machine_id)
    for volume in volume_keeper(robot.provider).volumes():
        volume_keeper(robot.provider).delete_volume(volume.id)
    # Azure asks for these of resources that a request names
    linked = {action for action in role['Actions'] if '/join/' in action or 'GetAccess' in action}
    asked = robot.azure.actions
    # a PUT is polled by its resource; some operations of networks may have a result alone
    polled = {action for action in role['Actions'] if action.endswith('/read')
              and 'perations/' not in action and '/operationresults/' not in action}
    assert asked <= set(role['Actions']) - linked
    assert set(role['Actions']) - linked - polled <= asked


# -- the rest -----------------------------------------------------------------------------------


def test_image_is_baked_reused_and_deleted(robot):
    machine_id = robot.create()
    image_id = image_keeper(robot.provider).bake(machine_id, 'planner', 'abcd')
    wait_until(lambda: [one.state for one in image_keeper(robot.provider).images()]
               == ['available'], timeout=60.0, what='the image')
    request = robot.request(dependencies='abcd')
    again = robot.provider.create(robot.spec('mapper'), request)
    assert image_id.split('/')[1] in robot.provider.describe(again).image
    assert robot.provider.describe(again).tags[TAG_DEPENDENCIES] == 'abcd'
    for one in (machine_id, again):
        robot.provider.destroy(one)
    assert len(robot.azure.groups) == 1
    image_keeper(robot.provider).delete_image(image_id)
    assert robot.azure.groups == {}


def test_machine_of_an_image_fits_its_disk_and_its_controller(robot):
    machine_id = robot.create(disk_size=100)
    image_keeper(robot.provider).bake(machine_id, 'planner', 'abcd')
    wait_until(lambda: [one.state for one in image_keeper(robot.provider).images()]
               == ['available'], timeout=60.0, what='the image')
    again = robot.provider.create(robot.spec('mapper', vm_size='Standard_D2s_v6'),
                                  robot.request(dependencies='abcd'))
    assert robot.provider.describe(again).disk_gb == 100
    (version,) = [entry['id'] for key, entry in robot.azure.resources.items()
                  if '/versions/' in key]
    named = robot.provider.create(robot.spec('seer', image=version), robot.request())
    assert robot.provider.describe(named).image == version
    for one in (machine_id, again, named):
        robot.provider.destroy(one)


def test_cheapest_size_is_one_that_takes_the_request(robot):
    spec = robot.spec(vm_size='cheapest', arch='x86_64', min_cpu=2, min_memory_gb=4)
    machine_id = robot.provider.create(robot.provider.resolve(spec), robot.request())
    assert robot.provider.describe(machine_id).kind == SMALL
    robot.provider.destroy(machine_id)


def test_group_of_somebody_else_is_no_image(robot):
    robot.azure.groups['fogros2-image-0123456789ab'] = {
        'name': 'fogros2-image-0123456789ab', 'location': HOME, 'tags': {},
        'properties': {'provisioningState': 'Succeeded'}}
    with pytest.raises(ProviderError, match='no image of FogROS2'):
        image_keeper(robot.provider).delete_image(f'azure:{HOME}/fogros2-image-0123456789ab')
    assert robot.azure.groups


def test_failed_bake_leaves_no_group(robot):
    machine_id = robot.create()
    robot.azure.faults.append(Fault('Wrong', 400, 'PUT', 'galleries'))
    with pytest.raises(ProviderError, match='Wrong'):
        image_keeper(robot.provider).bake(machine_id, 'planner', 'abcd')
    wait_until(lambda: len(robot.azure.vms()) == len(robot.azure.groups) == 1, timeout=60.0,
               what='the group to be deleted')
    robot.provider.destroy(machine_id)


def test_machine_joins_the_network_of_the_user_s_group(robot):
    base = f'/subscriptions/{service.SUBSCRIPTION}/resourceGroups/robots'
    robot.azure.groups['robots'] = {
        'id': base, 'name': 'robots', 'location': HOME, 'tags': {},
        'properties': {'provisioningState': 'Succeeded'}}
    network = f'{base}/providers/Microsoft.Network/virtualNetworks/lab'
    robot.azure.resources[network.lower()] = {
        'id': network, 'name': 'lab', 'location': HOME, 'type': 'Microsoft.Network/'
        'virtualNetworks', 'properties': {'provisioningState': 'Succeeded', 'subnets': [
            {'id': f'{network}/subnets/a', 'name': 'a', 'properties': {}}]}}
    before = dict(robot.azure.resources)
    machine_id = robot.create(resource_group='robots')
    machine = robot.reach(machine_id)
    assert 'lab' in machine.private_network and machine.private_ip
    assert robot.asked('virtualnetworks', 'PUT') == []
    robot.provider.destroy(machine_id)
    assert {key: entry for key, entry in robot.azure.resources.items()
            if '/roledefinitions/' not in key} == before
    assert set(robot.azure.groups) == {'robots'}
    # without a network there, the machine gets its own
    del robot.azure.resources[network.lower()]
    for group in ('robots', 'of-nobody'):
        robot.provider.destroy(robot.create(resource_group=group))


def test_ssh_rule_changes_and_ends(robot):
    machine_id = robot.create(ssh_from=['203.0.113.0/24'])

    def sources():
        return [entry['properties']['sourceAddressPrefixes'] for key, entry
                in robot.azure.resources.items() if key.endswith('/securityrules/tcp-22')]

    assert sources() == [['203.0.113.0/24']]
    robot.provider.allow(machine_id, 22, ['198.51.100.9/32'])
    assert sources() == [['198.51.100.9/32', '203.0.113.0/24']]
    robot.provider.allow(machine_id, 22, [])
    assert sources() == []
    robot.provider.destroy(machine_id)


def test_a_changed_rule_is_waited_for(robot):
    """Azure answers a change of a resource with 200, and needs time for it all the same."""
    machine_id = robot.create()
    robot.provider.allow(machine_id, 8765, ['198.51.100.0/24'])
    robot.azure.delay = 0.5
    robot.provider.allow(machine_id, 8765, ['203.0.113.0/24'])
    (rule,) = [entry for key, entry in robot.azure.resources.items() if key.endswith('tcp-8765')]
    assert rule['properties']['provisioningState'] == 'Succeeded'
    robot.provider.destroy(machine_id)


def test_no_room_at_a_start_is_named(robot):
    machine_id = robot.create()
    robot.reach(machine_id)
    robot.provider.stop(machine_id)
    wait_until(lambda: robot.provider.describe(machine_id).state is MachineState.STOPPED,
               timeout=60.0, what='the stop')
    robot.azure.faults.append(Fault('AllocationFailed', 409, 'POST', 'virtualMachines', late=True))
    with pytest.raises(ProviderError, match='no free machine'):
        robot.provider.start(machine_id)
    robot.provider.destroy(machine_id)


def test_service_that_does_not_answer_is_one_line(robot, monkeypatch):
    monkeypatch.setenv('FOGROS2_AZURE_ENDPOINT', 'http://127.0.0.1:9')
    with pytest.raises(PrerequisiteError, match='Azure does not answer'):
        robot.create()
    monkeypatch.setenv('IDENTITY_ENDPOINT', 'http://127.0.0.1:9/token')
    monkeypatch.setattr('fogros2.provider.azure.cloud._USUAL', Account())
    with pytest.raises(PrerequisiteError, match='Azure does not answer: Failed to'):
        Robot(robot.azure).create()


def test_another_server_gets_no_token(robot, monkeypatch):
    answer = robot.azure.answer

    def elsewhere(*words):
        status, headers, body = answer(*words)
        return status, {key: value.replace('127.0.0.1', '127.0.0.2') if 'http' in value else value
                        for key, value in headers.items()}, body

    monkeypatch.setattr(robot.azure, 'answer', elsewhere)
    with pytest.raises(ProviderError, match='named another server'):
        robot.provider.destroy(robot.create())
