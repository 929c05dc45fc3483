# SPDX-License-Identifier: Apache-2.0
"""Decisions of the Azure provider, by value: options, requests, states, prices, errors."""

from __future__ import annotations

import base64
import dataclasses
from decimal import Decimal
import json
import re
import time
from types import SimpleNamespace

import pytest

from fogros2 import AzureCloudInstance
from fogros2.errors import ConfigurationError, PrerequisiteError, ProviderError
from fogros2.model import CreateRequest, MachineSpec, MachineState
from fogros2.provider import TAG_DEPENDENCIES
from fogros2.provider.azure import account, ending, failures, login, machines, prices
from fogros2.provider.azure.images import AzureImages, TAG_KIND
from fogros2.provider.azure.machines import Prepared
from fogros2.provider.azure.options import Options
from fogros2.provider.vm.cloud import Order, Place, TAG_DISK, TAG_MADE
from fogros2.provider.vm.failures import Silent
from fogros2.provider.vm.rest import Answer
from rigs.azure import catalogue, schema

SPEC = MachineSpec('planner', 'azure', {'region': 'westeurope'})
REQUEST = CreateRequest('5f0c7ab8', 'ssh-ed25519 AAAA robot\n', {'fogros2-launch': 'l1'}, 51820)
KNOWN = Prepared({'id': '/image'}, 30, False, True, '', True)
PLACE = Place('westeurope', 'Standard_B2als_v2')


def order(**options):
    return Order(SPEC, REQUEST, Options.parse(options), {'fogros2-attempt': 'ab' * 8},
                 b'user data', ['198.51.100.7/32', '2001:db8::1/128'])


@pytest.mark.parametrize(('options', 'words'), [
    ({'vm_siz': 'Standard_B2s'}, "did you mean 'vm_size'"),
    ({'region': 'West Europe'}, "it takes 'westeurope' or 'nearest'"),
    ({'vm_size': 't3.medium'}, "can't be the vm_size"),
    ({'image': 'ubuntu'}, 'publisher:offer:sku:version'),
    ({'resource_group': 'a b'}, 'the name of a resource group'),
    ({'tags': {'a/b': 'x'}}, "can't be a tag"),
    ({'tags': {'azure-team': 'x'}}, "can't be a tag"),
    ({'tags': {f'key{n}': 'x' for n in range(31)}}, 'at most 30'),
    ({'ssh_from': [f'198.51.100.{n}' for n in range(40)]}, 'too many networks'),
])
def test_a_wrong_option_is_named_with_what_to_do(options, words):
    with pytest.raises(ConfigurationError) as caught:
        Options.parse(options)
    assert words in str(caught.value)


def test_keywords_of_pull_request_109_are_accepted():
    machine = AzureCloudInstance('robots', 'UbuntuLTS', 'eastus', 'Standard_DS2_v2', 10)
    assert machine.info()['compute_region'] == 'eastus'
    assert machine.info()['compute_instance_type'] == 'Standard_DS2_v2'
    options = Options.parse({'image': 'UbuntuLTS', 'disk_size': 10, 'resource_group': 'robots'})
    body = machines.request(PLACE, dataclasses.replace(order(), options=options), KNOWN, '', {})
    assert body['properties']['storageProfile']['osDisk']['diskSizeGB'] == 30
    with pytest.raises(ConfigurationError, match='are the same option'):
        AzureCloudInstance(zone='eastus', region='eastus')


def test_request_is_one_that_azure_s_models_have():
    body = machines.request(PLACE, order(spot=True, max_price=0.02), KNOWN, '/nic', {'a': 'b'})
    assert schema.unknown('virtualmachines', body) == ''
    what = body['properties']
    assert (what['priority'], what['billingProfile']) == ('Spot', {'maxPrice': 0.02})
    assert base64.b64decode(what['osProfile']['customData']) == b'user data'
    assert what['osProfile']['linuxConfiguration']['ssh']['publicKeys'] == [
        {'path': '/home/ubuntu/.ssh/authorized_keys', 'keyData': 'ssh-ed25519 AAAA robot'}]
    assert schema.unknown('virtualmachines', {'properties': {'osProfil': {}}})
    assert schema.unknown('virtualmachines', {'properties': {'storageProfile': {'osDisk': {
        'managedDisk': {'storageType': 'x'}}}}})


def test_spot_without_a_limit_costs_at_most_the_price_on_demand():
    body = machines.request(PLACE, order(spot=True), KNOWN, '', {})
    assert body['properties']['billingProfile'] == {'maxPrice': -1}


def test_firewall_admits_the_robot_and_nobody_else():
    rules = {rule['name']: rule['properties'] for rule in machines.firewall(order())[
        'securityRules']}
    assert rules['tcp-22']['sourceAddressPrefixes'] == ['198.51.100.7/32']
    assert rules['vpn']['protocol'] == 'Udp' and rules['vpn']['destinationPortRange'] == '51820'
    assert rules['nothing-else']['access'] == 'Deny'
    # before Azure's own rule that lets a whole virtual network in
    assert max(rule['priority'] for rule in rules.values()) == \
        rules['nothing-else']['priority'] < 65000


def test_firewall_admits_robots_of_a_fleet_to_published_ports():
    options = Options.parse({'fleet': ['ssh-ed25519 AAAA'], 'ssh_from': ['198.51.100.0/24']})
    body = {'properties': machines.firewall(dataclasses.replace(order(), options=options))}
    assert schema.unknown('networkSecurityGroups', body) == ''
    found = {rule['properties']['protocol']: rule['properties'] for rule in
             body['properties']['securityRules'] if rule['name'].startswith('fleet-')}
    assert sorted(found) == ['Tcp', 'Udp']
    for rule in found.values():
        assert rule['destinationPortRange'] == '32768-60999'
        assert rule['sourceAddressPrefixes'] == ['198.51.100.7/32']


def test_names_come_from_the_token_and_the_place():
    here = machines.name_of(order(), PLACE)
    assert here == machines.name_of(order(), PLACE)
    assert here != machines.name_of(order(), PLACE._replace(kind='Standard_D2s_v5'))
    assert re.fullmatch('fogros2-[0-9a-f]{16}-[0-9a-f]{8}', here)


@pytest.mark.parametrize(('making', 'power', 'state'), [
    ('Creating', '', MachineState.PENDING), ('Creating', 'starting', MachineState.PENDING),
    ('Succeeded', 'running', MachineState.RUNNING), ('Updating', 'running', MachineState.RUNNING),
    ('Updating', 'deallocating', MachineState.STOPPING),
    ('Succeeded', 'deallocated', MachineState.STOPPED),
    ('Updating', 'deallocated', MachineState.PENDING),
    ('Succeeded', 'stopped', MachineState.STOPPED), ('Failed', '', MachineState.STOPPED),
    ('Failed', 'running', MachineState.RUNNING), ('Deleting', 'running', MachineState.DELETED)])
def test_states_of_azure_are_states_of_machines(making, power, state):
    entry = {'id': '/subscriptions/s/resourceGroups/G/providers/x/y/z', 'location': 'West Europe',
             'properties': {'provisioningState': making, 'instanceView': {'statuses': [
                 {'code': f'ProvisioningState/{making}'},
                 *([{'code': f'PowerState/{power}'}] if power else [])]}}}
    found = machines.vm_of(entry)
    assert (found.state, found.region, found.id) == (state, 'westeurope', 'g')
    assert found.billed == (power == 'stopped')  # 'deallocated' is not


def test_time_of_azure_is_read_with_any_decimals():
    assert machines.when('2026-01-02T03:04:05.1234567+00:00') == 1767323045.0
    assert machines.when('2026-01-02T03:04:05Z') == 1767323045.0
    assert machines.when(None) is None


@pytest.mark.parametrize(('code', 'message', 'full', 'words'), [
    ('SkuNotAvailable', 'not in westeurope', 'zone', 'vm_sizes='),
    ('OverconstrainedAllocationRequest', 'x', 'zone', 'no free machine'),
    ('AllocationFailed', 'x', 'zone', 'no free machine'),
    ('SpotPriceGreaterThanProvidedMaxPrice', 'x', 'zone', 'above max_price='),
    ('QuotaExceeded', 'x', 'region', 'quota'),
    ('OperationNotAllowed', 'exceeding approved Total Regional Cores quota', 'region', 'quota'),
    ('OperationNotAllowed', 'another operation is in progress', '', 'try again'),
    ('AuthorizationFailed', "does not have authorization to perform action 'Microsoft.Compute/"
     "virtualMachines/write' over scope", '', 'Microsoft.Compute/virtualMachines/write'),
    ('MissingSubscriptionRegistration', "namespace 'Microsoft.Compute'", '', 'az provider'),
    ('RequestDisallowedByPolicy', 'no public addresses', '', 'no public addresses'),
    ('ScopeLocked', 'locked', '', 'az lock'), ('Unauthorized', 'no token', '', 'az login'),
    ('SomethingNew', 'so it is', '', 'so it is')])
def test_refusal_says_what_it_means(code, message, full, words):
    error = failures.refusal(409, {'error': {'code': code, 'message': message}}, 'creating it')
    assert words in str(error) and str(error).startswith('creating it failed')
    assert getattr(error, 'full', '') == full
    assert error.refused


def test_inner_code_of_a_failed_operation_counts():
    error = failures.refusal(400, {'error': {'code': 'DeploymentFailed', 'details': [
        {'code': 'ZonalAllocationFailed', 'message': 'x'}]}}, 'creating it')
    assert error.full == 'zone'


def test_fault_of_azure_leaves_open_whether_it_had_an_effect():
    assert not failures.refusal(500, None, 'creating it').refused
    assert failures.refusal(404, None, 'looking').gone


def test_sizes_have_architecture_and_gpu():
    sizes = {entry['name']: prices.machine_type(entry)
             for entry in catalogue.skus('westeurope', set())
             if entry['resourceType'] == 'virtualMachines'}
    assert sizes['Standard_B2als_v2'].cpu == 'AMD' and sizes['Standard_B2als_v2'].cores == 1
    assert sizes['Standard_B2pls_v2'].arch == 'arm64'
    gpu = sizes['Standard_NC4as_T4_v3']
    assert (gpu.gpus, gpu.gpu, gpu.gpu_memory_gb) == (1, 'NVIDIA T4', 16.0)
    assert not sizes['Standard_DS2_v2'].spot


@pytest.mark.parametrize(('name', 'gpu'), [
    ('Standard_NC6s_v3', 'NVIDIA V100'), ('Standard_NV4as_v4', 'AMD MI25'),
    ('Standard_NV12s_v3', 'NVIDIA M60'), ('Standard_NC24ads_A100_v4', 'NVIDIA A100'),
    ('Standard_NV36ads_A10_v5', 'NVIDIA A10'), ('Standard_ND96isr_H100_v5', 'NVIDIA H100'),
    ('Standard_ND96isr_MI300X_v5', 'AMD MI300X')])
def test_gpu_is_known_from_the_name_of_a_size(name, gpu):
    entry = {'name': name, 'capabilities': [
        {'name': key, 'value': value} for key, value in (
            ('vCPUs', '6'), ('MemoryGB', '112'), ('GPUs', '1'))]}
    assert prices.machine_type(entry).gpu == gpu


def test_prices_are_those_of_linux():
    found = [prices.retail_price(entry) for entry in catalogue.retail('westeurope')]
    assert {one for one in found if one and one[0] == 'Standard_B2als_v2'} == {
        ('Standard_B2als_v2', Decimal('0.0376'), False),
        ('Standard_B2als_v2', Decimal('0.0094'), True)}


@pytest.mark.parametrize(('actions', 'not_actions', 'may'), [
    (['*'], [], True), (['*'], ['Microsoft.Authorization/*/Write'], False),
    (['Microsoft.Compute/*'], [], False),
    (['Microsoft.Authorization/roleAssignments/*'], [], True), ([], [], False)])
def test_right_to_assign_roles_is_read_from_permissions(actions, not_actions, may):
    assert ending.grants({'actions': actions, 'notActions': not_actions}) is may


def test_role_of_machines_is_the_narrowest(monkeypatch):
    monkeypatch.setenv('AZURE_SUBSCRIPTION_ID', 'one')
    (permission,) = ending.role()['properties']['permissions']
    assert len(permission['actions']) == 2 and not any('*' in one for one in permission['actions'])


def test_subscription_is_that_of_the_environment_or_of_the_login(monkeypatch, tmp_path):
    monkeypatch.setenv('AZURE_CONFIG_DIR', str(tmp_path))
    monkeypatch.delenv('AZURE_SUBSCRIPTION_ID', raising=False)
    assert not login.configured()
    with pytest.raises(PrerequisiteError, match='no subscription'):
        account.subscription()
    # az writes a byte order mark
    (tmp_path / 'azureProfile.json').write_text(json.dumps({'subscriptions': [
        {'id': 'one', 'isDefault': False}, {'id': 'two', 'isDefault': True}]}), 'utf-8-sig')
    assert login.configured() and account.subscription() == 'two'
    monkeypatch.setenv('AZURE_SUBSCRIPTION_ID', 'three')
    assert account.subscription() == 'three'


class Credential:
    """
    A credential of azure-identity that keeps no token.

    :param answers: tokens' ends in seconds from now, or errors.
    """

    def __init__(self, *answers):
        self.answers = [*answers]

    def get_token(self, *scopes, **_):
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return SimpleNamespace(token=f'until {answer}', expires_on=int(time.time() + answer))


def test_token_is_kept_as_long_as_it_is_valid(monkeypatch):
    pytest.importorskip('azure.core')
    credential, own = Credential(60, 3600), account.Account()
    monkeypatch.setattr(own, 'credential', lambda: credential)
    assert [own.having(None).token('asking') for _ in range(5)] == [
        'until 60', *4 * ['until 3600']]


@pytest.mark.parametrize(('error', 'kind', 'words'), [
    ("it failed: Failed to resolve 'login.example'", Silent, "er: Failed to resolve 'login.ex"),
    ('it failed: AADSTS7000215', PrerequisiteError, 'there are no credentials')])
def test_token_without_a_network_is_no_lack_of_credentials(monkeypatch, error, kind, words):
    identity = pytest.importorskip('azure.identity')
    from azure.core.exceptions import ClientAuthenticationError
    own = account.Account()
    chain = identity.ChainedTokenCredential(Credential(ClientAuthenticationError(error)))
    monkeypatch.setattr(own, 'credential', lambda: chain)
    with pytest.raises(PrerequisiteError, match=re.escape(words)) as caught:
        own.token('asking')
    assert type(caught.value) is kind


def test_newest_image_is_not_one_of_1970():
    groups = [{'name': name, 'tags': {
        TAG_MADE: made, TAG_DEPENDENCIES: 'abcd', TAG_KIND: 'amd64 V2', TAG_DISK: '30'}}
        for name, made in (('today', '1796000000'), ('old', '900'))]
    provider = SimpleNamespace(_image_groups=lambda region, query: groups,
                               _state=lambda group: 'available', _version=lambda group: group)
    newest = AzureImages.baked(provider, 'westus', Options(), 'abcd')
    assert newest == {('amd64', 'V2'): ('today', 30)}


def test_end_of_a_machine_is_by_the_clock_of_azure(monkeypatch):
    bodies = []

    def answer(method, url, what, body, **options):
        bodies.append(body)
        return Answer(200, {'Date': 'Mon, 30 Nov 2026 10:00:00 GMT'}, {})

    monkeypatch.setenv('AZURE_SUBSCRIPTION_ID', 'one')
    monkeypatch.delenv(account.ENDPOINT_VARIABLE, raising=False)
    monkeypatch.setattr(time, 'time', lambda: 0.0)  # a robot without a battery
    own = account.Account()
    monkeypatch.setattr(own, 'having', lambda cancel: own)
    monkeypatch.setattr(own, 'ask', answer)
    own.call('GET', own.vm('planner'), 'looking')
    first = ending.schedule(own, 'planner', 'westus', 8 * 3600.0)
    assert time.strftime('%d %H:%M', time.gmtime(first)) == '30 18:02'
    assert bodies[-1]['properties']['dailyRecurrence'] == {'time': '1802'}


@pytest.mark.parametrize(('link', 'followed'), [
    ('https://management.azure.com/next', True), ('https://management.azure.com:443/next', True),
    ('https://MANAGEMENT.azure.com/next', True), ('http://management.azure.com/next', False),
    ('https://management.azure.com:444/next', False), ('https://azure.example/next', False),
    ('https://management.azure.com.example/next', False), ('https://[', False),
    ('https://azure.example\\@management.azure.com/next', False),
    ('https://me@management.azure.com/next', False)])
def test_next_page_is_asked_for_at_azure_alone(monkeypatch, link, followed):
    monkeypatch.delenv(account.ENDPOINT_VARIABLE, raising=False)
    pages = iter([{'value': [1], 'nextLink': link}, {'value': [2]}])
    own = account.Account()
    monkeypatch.setattr(own, 'ask', lambda *words, **options: Answer(200, {}, next(pages)))
    found = own.pages('/subscriptions', 'looking')
    if followed:
        assert list(found) == [1, 2]
    else:
        with pytest.raises(ProviderError, match='named another server'):
            list(found)
