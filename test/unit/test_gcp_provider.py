# SPDX-License-Identifier: Apache-2.0
"""Decisions of the provider of Google Cloud, by value: options, requests, states, errors."""

from __future__ import annotations

import base64
import dataclasses
from decimal import Decimal
import re
import shutil

import pytest

from fogros2.errors import (
    ConfigurationError,
    MachineNotFound,
    PrerequisiteError,
    ProviderError,
)
from fogros2.model import CreateRequest, MachineSpec, MachineState
from fogros2.provider import TAG_ON_EXIT
from fogros2.provider.gcp import account, failures, firewall, instances, prices
from fogros2.provider.gcp.options import Options
from fogros2.provider.gcp.provider import GCPProvider
from fogros2.provider.vm import cloud
from fogros2.provider.vm.cloud import Order, Place
from fogros2.provider.vm.failures import Silent
from fogros2.waiting import wait_until
from fogros2_features.images.keepers import image_keeper
from fogros2_features.prices.market import seller
from fogros2_features.prices.offers import wants
from fogros2_testing import request_for
from rigs.gce import catalogue, keys
from rigs.gce.api import Fault

SPEC = MachineSpec('planner', 'gcp', {})
REQUEST = CreateRequest('5f0c7ab8-3a60-4b66-a3ff-f6f0ff4b9a37', 'ssh-ed25519 AAAA robot',
                        {'fogros2-launch': 'l1'}, 51820)
IMAGE = {'path': 'projects/ubuntu-os-cloud/global/images/family/ubuntu-2404-lts-amd64',
         'size': 10, 'gpus': False}


# -- options ----------------------------------------------------------------------------------


def test_options_of_fogros2_are_accepted_in_every_form():
    options = Options.parse({
        'project_id': 'shade-prod', 'ami_image': 'projects/ubuntu-os-cloud/global/images/'
        'ubuntu-2204-jammy-v20220712a', 'zone': 'us-central1-a', 'machine_type': 'e2-medium',
        'disk_size': '10', 'spot': 'true', 'tags': {'note': 'A b'}})
    assert (options.region, options.zone) == ('us-central1', 'us-central1-a')
    assert options.disk_size == 10
    assert options.spot is True
    assert Options.parse({}).types == ['e2-medium']


@pytest.mark.parametrize(('options', 'words'), [
    ({'machine_typ': 'e2-medium'}, "did you mean 'machine_type'"),
    ({'zone': 'us-central1'}, "it takes 'us-central1-a'"),
    ({'zone': 'us-central1-a', 'region': 'europe-west3'}, 'is not in the region europe-west3'),
    ({'zone': 'us-central1-a', 'regions': ['europe-west3']}, 'belongs to one region'),
    ({'project_id': '12345'}, "it takes the project's id, not its name or number"),
    ({'project_id': 'My Project'}, "can't be the project_id"),
    ({'machine_type': 'medium'}, "it takes 'e2-medium' or 'cheapest'"),
    ({'accelerators': 'T4'}, "it takes 'nvidia-tesla-t4'"),
    ({'service_account': 'robot'}, 'the email address'),
    ({'disk_size': 9}, 'disk_size= takes 10'),
    ({'tags': {'Team': 'slam'}}, "can't be a label"),
    ({'tags': {'x' * 64: 'slam'}}, "can't be a label"),
    ({'spot': True, 'max_price': 1}, 'Google takes no limit for a spot price'),
])
def test_wrong_option_is_named_with_what_to_do(options, words):
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        Options.parse(options)


# -- prices -----------------------------------------------------------------------------------


@pytest.mark.parametrize(('name', 'gpus', 'spot', 'price'), [
    ('e2-standard-4', {}, False, '0.17267112'), ('e2-medium', {}, True, '0.0086319'),
    ('n1-standard-1', {'nvidia-tesla-t4': 2}, False, '0.8811975'),
    ('e2-medium', {'nvidia-tesla-t4': 1}, True, '0.1286319'),
    ('g2-standard-4', {}, False, '0.90912'),
    ('c4-standard-2', {}, False, None), ('e2-medium', {'nvidia-l4': 1}, True, None)])
def test_price_is_the_sum_of_a_types_parts(name, gpus, spot, price):
    entry = catalogue.machine_types('europe-west3-b')[name]
    for skus in (catalogue.skus(), catalogue.skus()[::-1]):
        table = {key: value for sku in skus for key, value in prices.parts(sku).items()}
        cost = prices.price(table, 'europe-west3', entry, gpus, spot)
        assert cost == (None if price is None else Decimal(price))


def test_gpu_has_a_price_under_either_of_its_names():
    sku = {**catalogue.skus()[0], 'description': 'Nvidia Tesla A100 80GB GPU running in Frankfurt'}
    table = prices.parts(sku)
    entry = {'name': 'a2-x', 'guestCpus': 0, 'memoryMb': 0}
    rates = {**table, **{('europe-west3', 'a2', part, False): 0 for part in ('Core', 'Ram')}}
    (cost,) = table.values()
    assert prices.price(rates, 'europe-west3', entry, {'nvidia-a100-80gb': 2}, False) == 2 * cost


def test_regions_share_one_answer_of_the_catalogue(gce, monkeypatch):
    prices._asked.cache_clear()
    spec = MachineSpec('planner', 'gcp', {'region': 'europe-west3', 'machine_type': 'cheapest'})
    for key, words in (('', "Google's prices are not known here"),
                       ('AIza-of-another', 'a key for the Cloud Billing API')):
        monkeypatch.setenv(prices.KEY_VARIABLE, key)
        monkeypatch.setenv(prices.ENDPOINT_VARIABLE, f'{gce.url}/')
        with pytest.raises(ProviderError, match=words) as caught:
            GCPProvider().resolve(spec)
        assert 'AIza' not in str(caught.value)
    monkeypatch.setenv(prices.KEY_VARIABLE, catalogue.API_KEY)
    gce.api.calls.clear()
    found = seller(GCPProvider()).offers(wants(arch='x86_64'), ['europe-west3', 'europe-west1'])
    assert found.chosen.region == 'europe-west3'
    asked = [call for call in gce.api.calls if call.action == 'services.skus.list']
    assert len(asked) == 4  # pages
    prices._asked.cache_clear()


# -- requests ---------------------------------------------------------------------------------


def body(spec=SPEC, image=IMAGE, kind='e2-medium', **options):
    parsed = Options.parse(options)
    tags = cloud.own_tags(spec, REQUEST, parsed)
    order = Order(spec, REQUEST, parsed, tags, b'data', ())
    return instances.insertion(Place('us-central1', kind, 'us-central1-a'), order, image, '', tags)


def test_request_keeps_the_projects_users_out():
    items = {item['key']: item['value'] for item in body()['metadata']['items']}
    assert items['block-project-ssh-keys'] == 'TRUE'
    assert base64.b64decode(items['user-data']) == b'data'
    assert items['user-data-encoding'] == 'base64'
    assert body()['serviceAccounts'] == []


def test_disk_fits_the_image_and_the_type():
    assert body(disk_size=20)['disks'][0]['initializeParams']['diskSizeGb'] == '20'
    large = body(image={**IMAGE, 'size': 50})['disks'][0]['initializeParams']
    assert large['diskSizeGb'] == '50' and large['diskType'].endswith('/pd-balanced')
    new = body(kind='c4-standard-2')['disks'][0]['initializeParams']
    assert new['diskType'].endswith('/hyperdisk-balanced')


@pytest.mark.parametrize(('on_exit', 'options', 'gpus', 'expected'), [
    ('delete', {}, False, {'instanceTerminationAction': 'DELETE',
                           'maxRunDuration': {'seconds': '28800'}}),
    ('stop', {}, False, {'instanceTerminationAction': 'STOP',
                         'maxRunDuration': {'seconds': '28800'}}),
    ('keep', {}, False, {}),
    ('delete', {}, True, {'onHostMaintenance': 'TERMINATE'}),
    ('delete', {'spot': True}, False, {
        'provisioningModel': 'SPOT', 'onHostMaintenance': 'TERMINATE',
        'instanceTerminationAction': 'DELETE'}),
    ('keep', {'spot': True}, False, {'instanceTerminationAction': 'DELETE'}),
])
def test_google_ends_the_machine_at_its_lifetime(on_exit, options, gpus, expected):
    spec = dataclasses.replace(SPEC, on_exit=on_exit)
    found = instances.scheduling(spec, Options.parse(options), fixed=gpus)
    assert expected.items() <= found.items()
    assert found['automaticRestart'] is False
    if on_exit == 'keep':
        assert 'maxRunDuration' not in found


@pytest.mark.parametrize(('kind', 'maintenance'), [
    ('e2-medium', 'MIGRATE'), ('c3-highcpu-192', 'MIGRATE'), ('h4d-standard-192', 'TERMINATE'),
    ('h3-standard-88', 'TERMINATE'), ('c3-highcpu-192-metal', 'TERMINATE')])
def test_types_that_google_does_not_migrate_end(kind, maintenance):
    assert body(kind=kind)['scheduling']['onHostMaintenance'] == maintenance


@pytest.mark.parametrize(('lifetime', 'seconds'), [(1.0, '30'), (90.2, '91'), (1e9, '10368000')])
def test_lifetime_is_within_googles_limits(lifetime, seconds):
    spec = dataclasses.replace(SPEC, lifetime=lifetime)
    found = instances.scheduling(spec, Options(), fixed=False)
    assert found['maxRunDuration'] == {'seconds': seconds}


def test_accelerators_are_those_of_the_zone():
    (gpu,) = body(accelerators='nvidia-tesla-t4:2')['guestAccelerators']
    assert gpu == {'acceleratorType': 'zones/us-central1-a/acceleratorTypes/nvidia-tesla-t4',
                   'acceleratorCount': 2}


def test_zone_without_the_accelerator_is_passed_over(gce):
    spec = MachineSpec('planner', 'gcp', {
        'region': 'us-east1', 'machine_type': 'n1-standard-4', 'accelerators': 'nvidia-tesla-t4'})
    assert '/us-east1-c/' in GCPProvider().create(spec, request_for(spec))


def test_labels_carry_tags_of_any_characters(gce):
    provider = GCPProvider()
    spec = MachineSpec('planner', 'gcp', {
        'tags': {'team': 'slam', 'note': 'Grüße, Robot_7!' * 6}})
    machine = provider.create(spec, request_for(spec))
    (instance,) = gce.instances
    assert instance['labels']['team'] == 'slam' and 'Name' not in instance['labels']
    assert all(re.fullmatch('[a-z0-9_-]{0,63}', value) for value in instance['labels'].values())
    assert provider.describe(machine).tags['note'] == 'Grüße, Robot_7!' * 6
    # a shorter value leaves nothing of the longer one
    provider.adopt(machine, spec, {'note': 'B'})
    assert provider.describe(machine).tags['note'] == 'B'
    assert not [key for key in gce.instances[0]['labels'] if key.startswith('note_')]


def test_changed_labels_of_another_program_are_kept(gce):
    provider = GCPProvider()
    machine = provider.create(SPEC, request_for(SPEC))
    provider.describe(machine)
    (instance,) = gce.instances
    instance['labels']['other'] = 'x'
    instance['labelFingerprint'] = 'changed='
    provider.adopt(machine, SPEC, {'fogros2-launch': 'l2'})
    labels = gce.instances[0]['labels']
    assert (labels['other'], labels['fogros2-launch']) == ('x', 'l2')


# -- reports ----------------------------------------------------------------------------------


@pytest.mark.parametrize('stopped', [True, False])
def test_stopped_machine_is_no_leftover_and_gets_a_new_lifetime(gce, stopped):
    spec, provider = dataclasses.replace(SPEC, on_exit='stop'), GCPProvider()
    machine = provider.create(spec, request_for(spec, **{TAG_ON_EXIT: 'stop'}))
    provider.stop(machine)
    if stopped:
        wait_until(lambda: provider.describe(machine).state is MachineState.STOPPED, timeout=60,
                   what='it to be stopped')
    again = dataclasses.replace(SPEC, lifetime=60.0)
    provider.adopt(machine, again, {TAG_ON_EXIT: 'delete'})
    assert gce.instances[0]['scheduling']['maxRunDuration'] == {'seconds': '60'}
    provider.start(machine)
    assert provider.reachable(machine, name='planner', timeout=5.0).state is MachineState.RUNNING


@pytest.mark.parametrize(('status', 'on_exit', 'state'), [
    ('PROVISIONING', 'delete', MachineState.PENDING), ('STAGING', 'delete', MachineState.PENDING),
    ('RUNNING', 'delete', MachineState.RUNNING), ('REPAIRING', 'stop', MachineState.PENDING),
    ('STOPPING', 'stop', MachineState.STOPPING), ('TERMINATED', 'stop', MachineState.STOPPED),
    ('TERMINATED', 'keep', MachineState.STOPPED), ('TERMINATED', 'delete', MachineState.DELETED),
    ('SUSPENDED', 'stop', MachineState.STOPPED)])
def test_states_of_google_are_those_of_machines(status, on_exit, state):
    vm = instances.vm_of('robots', {
        'name': 'fogros2-0', 'zone': 'https://x/projects/robots/zones/europe-west3-b',
        'status': status, 'labels': {TAG_ON_EXIT: on_exit},
        'scheduling': {'instanceTerminationAction': 'STOP' if on_exit == 'stop' else 'DELETE'},
        'machineType': 'https://x/machineTypes/e2-medium',
        'creationTimestamp': '2026-11-23T08:00:00.000-08:00'})
    assert (vm.state, vm.region, vm.kind) == (state, 'europe-west3', 'e2-medium')
    assert vm.id == 'robots/europe-west3-b/fogros2-0'
    assert vm.created == 1795449600.0


def test_machine_that_shut_itself_down_is_a_leftover(gce):
    provider = GCPProvider()
    machine = provider.create(SPEC, request_for(SPEC, **{TAG_ON_EXIT: 'delete'}))
    assert provider.describe(machine).end_command[0] == 'python3'
    assert provider.cloud.end_command(machine, {TAG_ON_EXIT: 'stop'})[0] == 'shutdown'
    number = gce.instances[0]['id']
    gce.project.cloud.shut_down(number)
    gce.project.cloud.machines[number].thread.join()
    with pytest.raises(MachineNotFound, match='has ended'):
        provider.describe(machine)
    assert not list(provider.find({}))
    for rule in gce.own_firewalls:
        rule['description'] = re.sub('"fogros2-made": "[0-9]+"', '"fogros2-made": "1"',
                                     rule['description'])
    assert GCPProvider().tidy() == ["firewall and key of 'planner'"]
    assert gce.instances == [] and gce.own_firewalls == []


# -- firewall ---------------------------------------------------------------------------------


def test_image_has_the_driver_of_its_machine(gce):
    provider = GCPProvider()
    keeper = image_keeper(provider)

    def create(name, kind, dependencies='', **options):
        spec = MachineSpec(name, 'gcp', {
            'region': 'us-central1', 'machine_type': kind, **options})
        return provider.create(spec, dataclasses.replace(
            request_for(spec), dependencies=dependencies))

    accelerated = {'accelerators': 'nvidia-tesla-t4'}
    machines = {'plain': create('plain', 'e2-medium'), 'l4': create('l4', 'g2-standard-4'),
                't4': create('t4', 'n1-standard-1', **accelerated)}
    for name, machine_id in machines.items():
        keeper.bake(machine_id, name, f'of-{name}')
    wait_until(lambda: all(image.state == 'available' for image in keeper.images()),
               timeout=60.0, what='the images')
    for name in machines:
        images = {
            number: provider.describe(create(
                f'{name}-{number}', kind, f'of-{name}', **options)).image
            for number, (kind, options) in enumerate((
                ('e2-medium', {}), ('g2-standard-4', {}), ('n1-standard-1', accelerated)))}
        assert [f'fogros2-{name}-' in images[number] for number in images] == [
            name == 'plain', name != 'plain', name != 'plain']


def test_denial_is_between_our_rules_and_googles(gce):
    provider = GCPProvider()
    spec = MachineSpec('planner', 'gcp', {'ssh_from': ['198.51.100.0/28', '2001:db8::/64']})
    machine = provider.create(spec, request_for(spec))
    rules = {rule['name'].partition('-')[2].partition('-')[2]: rule for rule in gce.own_firewalls}
    assert rules['tcp-22']['sourceRanges'] == ['198.51.100.0/28']
    assert rules['vpn']['allowed'] == [{'IPProtocol': 'udp', 'ports': ['51820']}]
    assert rules['deny']['denied'] == [{'IPProtocol': 'all'}]
    for name in ('tcp-22', 'vpn'):
        assert rules[name]['priority'] < rules['deny']['priority'] < 65534
    # the networks of ssh_from= are admitted together with the others, at port 22 only
    provider.allow(machine, 22, ['198.51.100.77/32'])
    provider.allow(machine, 8766, ['198.51.100.78/32'])
    rules = {rule['name'].partition('-')[2].partition('-')[2]: rule for rule in gce.own_firewalls}
    assert rules['tcp-22']['sourceRanges'] == ['198.51.100.0/28', '198.51.100.77/32']
    assert rules['tcp-8766']['sourceRanges'] == ['198.51.100.78/32']
    provider.allow(machine, 22, [])
    assert not [rule for rule in gce.own_firewalls if rule['name'].endswith('tcp-22')]
    provider.destroy(machine)
    assert gce.own_firewalls == []


def test_robots_of_a_fleet_reach_the_ports_that_engines_publish(gce):
    provider = GCPProvider()
    spec = MachineSpec('planner', 'gcp', {
        'fleet': ['ssh-ed25519 AAAA'], 'ssh_from': ['198.51.100.0/28']}, on_exit='keep')
    machine = provider.create(spec, request_for(spec))
    assert {rule['allowed'][0]['IPProtocol']: (rule['allowed'][0]['ports'], rule['sourceRanges'])
            for rule in gce.own_firewalls if '-fleet-' in rule['name']} == dict.fromkeys(
                ('tcp', 'udp'), (['32768-60999'], ['198.51.100.0/28']))
    provider.destroy(machine)
    assert gce.own_firewalls == []


def test_robot_without_ipv4_is_told_before_creation(gce):
    spec = MachineSpec('planner', 'gcp', {'ssh_from': ['2001:db8::/64']})
    with pytest.raises(ConfigurationError, match='the robot has none'):
        GCPProvider().create(spec, request_for(spec))
    assert gce.own_firewalls == []


def test_rule_of_somebody_else_has_no_tags():
    assert firewall.tags_of({'description': 'made by hand'}) == {}
    assert firewall.tags_of({}) == {}


# -- errors -----------------------------------------------------------------------------------


def answer(reason, message='said', code=400):
    return {'error': {'code': code, 'message': message, 'errors': [{'reason': reason}]}}


@pytest.mark.parametrize(('status', 'reason', 'words', 'full', 'certain'), [
    (403, 'quotaExceeded', '', 'region', True), (403, 'forbidden', '', '', True),
    (503, 'backendError', '', '', False), (400, 'invalid', '', '', True),
    (404, 'notFound', "The resource 'projects/p/zones/us-east1-b/acceleratorTypes/nvidia-tesla-t4'"
     ' was not found', 'zone', True),
    (400, 'invalid', "Invalid value for field 'resource.guestAccelerators[0].acceleratorType': "
     "''. The referenced accelerator resource cannot be found.", 'zone', True),
    (404, 'notFound', "The resource 'projects/ubuntu-os-accelerator-images/global/images/x' was "
     'not found', '', True)])
def test_refusal_tells_what_can_be_tried(status, reason, words, full, certain):
    error = failures.refused(status, answer(reason, words), 'creating it')
    assert (error.full, error.refused) == (full, certain)
    assert 'creating it failed' in str(error)


def test_page_of_googles_front_end_is_a_temporary_fault():
    error = failures.refused(502, '<!DOCTYPE html>\n<title>Error 502</title>', 'creating it')
    assert str(error) == 'creating it failed: Google answered with status 502'
    assert (error.temporary, error.refused) == (True, False)


@pytest.mark.parametrize(('status', 'found', 'kind', 'words'), [
    (401, answer('authError'), PrerequisiteError, 'gcloud auth application-default login'),
    (403, answer('accessNotConfigured'), PrerequisiteError, 'gcloud services enable'),
    (404, answer('notFound', "The resource 'projects/x' was not found"), PrerequisiteError,
     'check project_id='),
    (404, answer('notFound', "The resource 'projects/x/global/networks/default' was not found"),
     ProviderError, 'name a network of the project: network='),
    (412, answer('conditionNotMet', 'Constraint constraints/compute.vmExternalIpAccess violated '
                 'for project 1. Add instance projects/p/zones/z/instances/fogros2-x to the '
                 'constraint to use external IP with it.'),
     ProviderError, 'ask who has assigned the policy'),
    (407, None, PrerequisiteError, 'is there a proxy'), (200, 'x', PrerequisiteError, 'a proxy')])
def test_unusable_accounts_are_named(status, found, kind, words):
    error = failures.refused(status, found, 'looking')
    assert isinstance(error, kind) and words in str(error)


@pytest.mark.parametrize(('code', 'full'), [
    ('ZONE_RESOURCE_POOL_EXHAUSTED', 'zone'), ('QUOTA_EXCEEDED', 'region'),
    ('INTERNAL_ERROR', '')])
def test_late_failure_of_an_operation_is_certain(code, full):
    error = failures.failed({'error': {'errors': [{'code': code, 'message': 'm'}]}}, 'creating')
    assert (error.full, error.refused) == (full, True)


def test_missing_credentials_are_named(monkeypatch, tmp_path):
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.setenv('CLOUDSDK_CONFIG', str(tmp_path))
    monkeypatch.delenv('GOOGLE_APPLICATION_CREDENTIALS', raising=False)
    assert GCPProvider.configured() is False
    with pytest.raises(PrerequisiteError, match='there are no Google credentials'):
        GCPProvider().check(SPEC)
    monkeypatch.setenv('GOOGLE_APPLICATION_CREDENTIALS', '/kye.json')
    assert GCPProvider.configured()  # so `ros2 fog list` reports the error
    with pytest.raises(PrerequisiteError, match="names '/kye.json', and there is no such file"):
        GCPProvider().check(SPEC)


def test_running_launch_takes_a_new_login(gce, monkeypatch, tmp_path):
    valid = gce.variables['GOOGLE_APPLICATION_CREDENTIALS']
    file = keys.write(tmp_path / 'renewed.json', keys.pair.__wrapped__()[0], gce.url)
    monkeypatch.setenv('GOOGLE_APPLICATION_CREDENTIALS', str(file))
    user = account.Account()
    with pytest.raises(PrerequisiteError, match='does not take these credentials'):
        user.token('asking')
    shutil.copy(valid, file)
    assert user.token('asking').startswith('ya29.')


@pytest.mark.parametrize(('text', 'retryable', 'kind'), [
    ('<!DOCTYPE html>\n<title>Error 502</title>', False, Silent),
    ('internal_failure: None', True, Silent),
    ('invalid_grant: Bad\nRequest', False, PrerequisiteError)])
def test_fault_of_the_token_server_is_no_refusal(gce, monkeypatch, text, retryable, kind):
    from google.auth.exceptions import RefreshError
    from google.oauth2.service_account import Credentials
    timeouts = []

    def refresh(own, request):
        timeouts.append(request.keywords['timeout'])
        raise RefreshError(text, retryable=retryable)

    monkeypatch.setattr(Credentials, 'refresh', refresh)
    with pytest.raises(PrerequisiteError) as caught:
        account.Account().token('asking')
    assert type(caught.value) is kind and '\n' not in str(caught.value)
    assert timeouts == 2 * [(5.0, 30.0)]


def test_project_is_that_of_the_options_first(gce, monkeypatch):
    assert account.Account().project == 'robots'
    monkeypatch.setenv('GOOGLE_CLOUD_PROJECT', 'other-project')
    assert account.Account().project == 'other-project'
    assert account.Account().of_project('third-project').project == 'third-project'


# -- where ------------------------------------------------------------------------------------


@pytest.mark.parametrize(('options', 'image', 'zone'), [
    ({'machine_type': 't2a-standard-1'}, 'ubuntu-2404-lts-arm64', 'us-central1-a'),
    ({'machine_type': 'g2-standard-4'}, 'ubuntu-accelerator-2404-amd64-with-nvidia-580',
     'us-central1-b'),
    ({'machine_type': 'n1-standard-4', 'accelerators': 'nvidia-tesla-t4', 'zone': 'us-east1-c'},
     'ubuntu-accelerator-2404-amd64-with-nvidia-580', 'us-east1-c')])
def test_image_and_zone_fit_the_type(gce, options, image, zone):
    spec = MachineSpec('planner', 'gcp', options)
    machine = GCPProvider().create(spec, request_for(spec))
    assert GCPProvider().describe(machine).image.endswith(f'/{image}')
    assert gce.instances[0]['zone'].endswith(f'/{zone}')


@pytest.mark.parametrize(('options', 'words'), [
    ({'ami_image': 'no-such'}, "there is no image 'no-such'"),
    ({'machine_type': 't2a-standard-1', 'ami_image':
      'projects/ubuntu-os-cloud/global/images/ubuntu-2204-jammy-v20220712a'}, 'X86_64 processors'),
    ({'machine_type': 'g2-standard-4', 'zone': 'us-central1-a'}, 'has no machine type')])
def test_what_does_not_exist_is_refused_before_creation(gce, options, words):
    spec = MachineSpec('planner', 'gcp', options)
    with pytest.raises(ConfigurationError, match=words):
        GCPProvider().create(spec, request_for(spec))
    assert gce.own_firewalls == []


def test_network_in_custom_mode_gets_its_subnetwork(gce):
    spec = MachineSpec('planner', 'gcp', {'network': 'robots', 'region': 'europe-west3'})
    GCPProvider().create(spec, request_for(spec))
    (nic,) = gce.instances[0]['networkInterfaces']
    assert nic['subnetwork'].endswith('/regions/europe-west3/subnetworks/robots')
    assert all(rule['network'].endswith('/robots') for rule in gce.own_firewalls)


@pytest.mark.parametrize('action', ['globalOperations.wait', 'zoneOperations.wait'])
def test_refused_look_at_an_operation_leaves_nothing(gce, action):
    gce.api.faults.append(Fault('forbidden', action))
    with pytest.raises(ProviderError, match='doc/gcp.md'):
        GCPProvider().create(SPEC, request_for(SPEC))
    wait_until(lambda: gce.instances == gce.own_firewalls == [], timeout=60, what='nothing')


def test_lists_have_all_pages(gce):
    gce.project.page = 1
    provider = GCPProvider()
    for name in ('one', 'two', 'three'):
        spec = MachineSpec(name, 'gcp', {})
        provider.create(spec, request_for(spec))
    assert {machine.name for machine in provider.find({})} == {'one', 'two', 'three'}
