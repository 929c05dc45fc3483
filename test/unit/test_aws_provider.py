# SPDX-License-Identifier: Apache-2.0
"""Decisions of the AWS provider, by value: options, requests, states, user data, errors."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import datetime
from decimal import Decimal
import errno
import gzip
import ipaddress
import json
import os
from pathlib import Path
import pwd
import re
import shutil
import signal
import socket
import ssl
import subprocess
import sys

import pytest
import yaml

from fogros2.agent_client import agent_program
from fogros2.deploy.steps import arming
from fogros2.errors import ConfigurationError, MachineNotFound, PrerequisiteError, ProviderError
from fogros2.model import CreateRequest, MachineSpec, MachineState
from fogros2.provider.aws import clients, failures, instances, login, network, prices
from fogros2.provider.aws.cloud import Ec2
from fogros2.provider.aws.options import Options
from fogros2.provider.aws.provider import AWSProvider
from fogros2.provider.vm import address, cloud
from fogros2.provider.vm import user_data as boot
from fogros2.provider.vm.cloud import Order, Place
from fogros2.provider.vm.host_key import one_time
from fogros2.waiting import wait_until
from rigs import serving
from rigs.ec2 import iam

ROOT = Path(__file__).resolve().parents[2]
KEY = 'ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJ3Tq0CrBqXbWb0bqzPkGrjsvC7OxUD3yAyRIqLHTNN9'
TOKEN = '5f0c7ab8-3a60-4b66-a3ff-f6f0ff4b9a37'
SPEC = MachineSpec('planner', 'aws', {'region': 'eu-central-1'})
REQUEST = CreateRequest(
    TOKEN, 'ssh-ed25519 AAAA robot', {'fogros2-launch': 'l1'}, 51820,
    agent_config={'machine': 'planner', 'directory': '/run/fogros2'}, dependencies='abcd')
IMAGE = {'ImageId': 'ami-1', 'RootDeviceName': '/dev/xvda', 'BlockDeviceMappings': [
    {'DeviceName': '/dev/xvda', 'Ebs': {'VolumeSize': 40}}]}


def spec(**options):
    return dataclasses.replace(SPEC, options={**SPEC.options, **options})


# -- options ----------------------------------------------------------------------------------


def test_options_of_fogros2_are_accepted_in_every_form():
    options = Options.parse({
        'ami_image': None, 'region': 'us-west-1', 'ec2_instance_type': 't2.xlarge',
        'disk_size': '40', 'spot': 'True', 'arch': 'amd64', 'min_cpu': '8', 'gpu': True,
        'max_price': '1.25', 'ssh_from': '198.51.100.0/24', 'tags': {'team': 'slam'}})
    assert options.disk_size == 40
    assert Options.parse({'disk_size': 30.0}).disk_size == 30
    assert options.spot is True
    assert options.arch == 'x86_64'
    assert options.min_cpu == 8.0
    assert options.gpu == '1'
    assert options.max_price == Decimal('1.25')
    assert options.ssh_from == ('198.51.100.0/24',)


@pytest.mark.parametrize(('options', 'chooses'), [
    ({}, False), ({'ec2_instance_type': 'cheapest'}, True), ({'min_cpu': 4}, True),
    ({'ec2_instance_type': 't3.large', 'min_cpu': 4}, False), ({'gpu': 1}, True)])
def test_a_type_is_chosen_where_none_is_named(options, chooses):
    assert Options.parse(options).chooses_type is chooses


@pytest.mark.parametrize(('options', 'words'), [
    ({'ec2_instance_typ': 't3.medium'}, "did you mean 'ec2_instance_type'"),
    ({'region': 'Frankfurt'}, "it takes 'eu-central-1' or 'nearest'"),
    ({'ec2_instance_type': 't3'}, "can't be the ec2_instance_type"),
    ({'ami_image': 'ubuntu'}, 'it takes ami-'),
    ({'arch': 'riscv'}, 'x86_64 or arm64'),
    ({'disk_size': 'lots'}, 'a whole number'),
    ({'disk_size': 30.5}, 'a whole number'),
    ({'disk_size': 7}, 'a disk can not have 7 GB'),
    ({'spot': 'perhaps'}, 'True or False'),
    ({'max_price': 'cheap'}, "can't be 'cheap'"),
    ({'instance_types': 't3.large'}, 'a list of strings'),
    ({'ssh_from': '300.0.0.1'}, 'no address or network'),
    ({'ssh_from': [f'198.51.{n}.0/24' for n in range(20)]}, 'too many networks'),
    ({'fleet': ['/home/me/.ssh/id_ed25519.pub'], 'ssh_from': '198.51.100.0/24'},
     'no public SSH key'),
    ({'fleet': [f'{KEY}\n{KEY}'], 'ssh_from': '198.51.100.0/24'}, 'no public SSH key'),
    ({'tags': {'fogros2-name': 'x'}}, "can't be a tag"),
    ({'ami_image': 'ami-1', 'regions': ['us-east-1']}, 'belongs to one region'),
    ({'subnet': 'subnet-1', 'region': 'nearest'}, 'belongs to one region'),
    ({'user': 'Robert; drop'}, 'it takes a login name'),
    ({'ami_image': {}}, 'ami_image is an empty mapping'),
    ({'ami_image': {'Oregon': 'ami-1'}}, "'Oregon' can't be the region"),
    ({'ami_image': {'us-west-2': 'ubuntu'}}, 'it takes ami-'),
    ({'ami_image': {'us-west-2': 1}}, 'it takes names and strings'),
    ({'ec2_instance_type': {'us-west-2': 'cheapest'}}, "can't have 'nearest' or 'cheapest'"),
    ({'ami_image': {'us-west-2': 'ami-1'}, 'subnet': {'eu-west-1': 'subnet-1'}},
     'ami_image and subnet have no region in common'),
])
def test_a_wrong_option_is_named_with_what_to_do(options, words):
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        Options.parse(options)


@pytest.mark.parametrize('words', [{}, {'on_exit': 'stop'}])
def test_machine_of_a_fleet_outlives_its_launch(words):
    options = {'fleet': [f'{KEY} robot two@lab:/x\n'], 'ssh_from': ['198.51.100.0/24']}
    assert Options.of(MachineSpec('gpu-box', 'aws', options, on_exit='keep')).fleet
    for networks in ([], '2001:db8::/64'):
        with pytest.raises(ConfigurationError, match='the networks .IPv4. of its robots'):
            AWSProvider().check(MachineSpec(
                'gpu-box', 'aws', {**options, 'ssh_from': networks}, on_exit='keep'))
    with pytest.raises(ConfigurationError, match='use the machine after the launch'):
        Options.of(MachineSpec('gpu-box', 'aws', options, **words))


def test_options_by_region_are_those_of_the_region():
    options = Options.parse({
        'ami_image': {'us-west-2': 'ami-1', 'eu-west-1': 'ami-2'}, 'regions': ['eu-west-1'],
        'subnet': {'eu-west-1': 'subnet-2', 'us-west-2': 'subnet-1'}, 'min_cpu': 4})
    here = options.in_region('eu-west-1')
    assert (here.ami_image, here.subnet, here.min_cpu) == ('ami-2', 'subnet-2', 4.0)
    assert options.common_regions() == ['us-west-2', 'eu-west-1']
    assert here.common_regions() is None
    with pytest.raises(ConfigurationError, match='no value for the region us-east-1'):
        options.in_region('us-east-1')


def test_spot_with_stop_is_refused_before_creation():
    with pytest.raises(ConfigurationError, match="can't be stopped"):
        Options.of(dataclasses.replace(spec(spot=True), on_exit='stop'))


# -- requests to EC2 -----------------------------------------------------------------------------


def request(options=None, **changes):
    asked = spec(**(options or {}))
    parsed = Options.parse(asked.options)
    asked = dataclasses.replace(asked, **changes)
    tags = cloud.own_tags(asked, REQUEST, parsed)
    order = Order(asked, REQUEST, parsed, tags, b'x', ())
    return instances.run_request(Place('eu-central-1', 't3.medium'), order, IMAGE, 'sg-own', tags)


def token(place):
    return Order(SPEC, REQUEST, None, {}, b'', ()).token(place)


def test_a_machine_is_asked_for_as_it_has_to_be():
    words = request({'iam_instance_profile': 'robots'})
    attempt = cloud.attempt_of(TOKEN)
    tags = {'Name': 'planner', 'fogros2-launch': 'l1', 'fogros2-name': 'planner',
            'fogros2-attempt': attempt, 'fogros2-user': 'ubuntu',
            'fogros2-dependencies': 'abcd', 'fogros2-disk-gb': '40'}
    listed = [{'Key': key, 'Value': value} for key, value in tags.items()]
    assert words == {
        'ImageId': 'ami-1', 'InstanceType': 't3.medium', 'MinCount': 1, 'MaxCount': 1,
        'ClientToken': token(Place('eu-central-1', 't3.medium')),
        'KeyName': f'fogros2-{attempt}', 'UserData': b'x',
        'InstanceInitiatedShutdownBehavior': 'terminate',
        'MetadataOptions': {'HttpTokens': 'required', 'HttpEndpoint': 'enabled',
                            'HttpPutResponseHopLimit': 1},
        # the image's own disk is larger than what was asked for
        'BlockDeviceMappings': [{'DeviceName': '/dev/xvda', 'Ebs': {
            'VolumeSize': 40, 'VolumeType': 'gp3', 'Encrypted': True,
            'DeleteOnTermination': True}}],
        'TagSpecifications': [{'ResourceType': kind, 'Tags': listed}
                              for kind in ('instance', 'volume', 'network-interface')],
        # EC2 chooses a subnet, which may give no public addresses itself
        'NetworkInterfaces': [{
            'DeviceIndex': 0, 'Groups': ['sg-own'], 'AssociatePublicIpAddress': True,
            'DeleteOnTermination': True}],
        'IamInstanceProfile': {'Name': 'robots'},
    }


def test_a_machine_to_be_stopped_stops_at_its_shutdown():
    assert request(on_exit='stop')['InstanceInitiatedShutdownBehavior'] == 'stop'
    assert request(on_exit='keep')['InstanceInitiatedShutdownBehavior'] == 'terminate'


def test_a_spot_machine_is_asked_for_once_and_with_its_cap():
    words = request({'spot': True, 'max_price': 0.5})
    assert words['InstanceMarketOptions'] == {'MarketType': 'spot', 'SpotOptions': {
        'SpotInstanceType': 'one-time', 'InstanceInterruptionBehavior': 'terminate',
        'MaxPrice': '0.5'}}
    assert words['TagSpecifications'][-1]['ResourceType'] == 'spot-instances-request'


def test_type_with_part_of_a_gpu_needs_a_named_image(monkeypatch):
    kind = prices.instance_type({
        'InstanceType': 'g6f.large', 'ProcessorInfo': {'SupportedArchitectures': ['x86_64']},
        'VCpuInfo': {'DefaultVCpus': 2}, 'MemoryInfo': {'SizeInMiB': 8192}, 'GpuInfo': {'Gpus': [{
            'Name': 'L4', 'Manufacturer': 'NVIDIA', 'Count': 1, 'GpuPartitionSize': 0.125}]}})
    assert kind.gpus == 0
    with pytest.raises(ConfigurationError, match='only part of a GPU') as caught:
        Ec2().image_for('eu-central-1', kind, Options.parse({}), 'abcd')
    assert 'ami_image=' in caught.value.hint
    monkeypatch.setattr(Ec2, '_named', lambda *words: IMAGE)
    named = Options.parse({'ami_image': 'ami-1'})
    assert Ec2().image_for('eu-central-1', kind, named, '') is IMAGE


def test_tokens_differ_by_place_and_tell_nothing_of_the_request():
    places = [Place('eu-central-1', 't3.medium'), Place('eu-central-1', 't3.medium', 'subnet-1'),
              Place('us-east-1', 't3.medium'), Place('eu-central-1', 't3.large')]
    tokens = [token(place) for place in places]
    assert len(set(tokens)) == 4
    assert tokens == [token(place) for place in places]
    assert all(len(token) <= 64 and TOKEN not in token for token in tokens)
    assert TOKEN not in cloud.attempt_of(TOKEN)


def test_a_filter_takes_a_tag_by_its_letters():
    assert instances.tag_filters({'fogros2-robot': r'a*b?c\d'})[1] == {
        'Name': 'tag:fogros2-robot', 'Values': [r'a\*b\?c\\d']}


# -- what EC2 says ------------------------------------------------------------------------------


def instance(state='running', **more):
    tags = {'fogros2-name': 'planner', 'fogros2-attempt': '0123456789abcdef',
            'fogros2-host-key': 'ssh-ed25519 AAAA', 'fogros2-user': 'ubuntu',
            'fogros2-price-per-hour': '0.0416', 'fogros2-disk-gb': '30'}
    return {
        'InstanceId': 'i-0abc', 'State': {'Name': state}, 'InstanceType': 't3.medium',
        'ImageId': 'ami-1', 'KeyName': 'fogros2-0123', 'PublicIpAddress': '198.51.100.9',
        'PrivateIpAddress': '10.0.0.9', 'VpcId': 'vpc-1', 'LaunchTime': datetime.datetime(
            2026, 1, 1, tzinfo=datetime.timezone.utc),
        'Tags': instances.tag_list(tags), **more}


def machine_of(entry):
    return AWSProvider().machine_of(instances.vm_of('eu-central-1', entry))


def test_an_instance_becomes_a_machine():
    machine = machine_of(instance())
    assert machine.id == 'aws:eu-central-1/i-0abc/0123456789abcdef'
    assert (machine.name, machine.state, machine.region) == (
        'planner', MachineState.RUNNING, 'eu-central-1')
    assert (machine.endpoint.host, machine.endpoint.user, machine.endpoint.host_key) == (
        '198.51.100.9', 'ubuntu', 'ssh-ed25519 AAAA')
    assert (machine.vpn_host, machine.private_network, machine.private_ip) == (
        '198.51.100.9', 'aws:vpc-1', '10.0.0.9')
    assert machine.cost_per_hour == Decimal('0.0416')
    assert machine.created == 1767225600.0
    assert (machine.image, machine.key, machine.disk_gb) == ('ami-1', 'fogros2-0123', 30)
    assert machine.end_command == ('shutdown', '-h', 'now')


@pytest.mark.parametrize(('state', 'ours'), [
    ('pending', 'pending'), ('running', 'running'), ('stopping', 'stopping'),
    ('stopped', 'stopped'), ('shutting-down', 'deleted'), ('terminated', 'deleted')])
def test_every_state_has_a_word(state, ours):
    machine = machine_of(instance(state))
    assert str(machine.state) == ours
    assert (machine.endpoint is not None) == (state == 'running')


def test_a_machine_says_since_when_it_is_stopped():
    machine = machine_of(instance(
        'stopped', StateTransitionReason='User initiated (2026-01-01 00:00:00 GMT)'))
    assert machine.stopped == 1767225600.0
    assert machine_of(instance('stopped')).stopped is None


def test_the_address_is_the_public_one_or_what_there_is():
    six = [{'Ipv6Addresses': [{'Ipv6Address': '2001:db8::9'}]}]
    assert instances.address_of(instance(NetworkInterfaces=six)) == '198.51.100.9'
    assert instances.address_of(
        instance(PublicIpAddress=None, NetworkInterfaces=six)) == '2001:db8::9'
    assert instances.address_of(instance(PublicIpAddress=None)) == '10.0.0.9'


@pytest.mark.parametrize('text', [
    '', 'no-such-machine', 'i-0abc', 'aws:eu-central-1/i-0abc', 'aws:eu-central-1/i-0abc/xyz',
    'aws:eu-central-1/i-0abc/0123456789abcdef/..'])
def test_a_foreign_id_is_no_machine(text):
    with pytest.raises(MachineNotFound):
        AWSProvider().describe(text)


def test_silent_region_hides_no_machine_of_another():
    def find(region):
        if region == 'us-east-1':
            raise ProviderError('us-east-1 does not answer')
        return [region]

    provider = AWSProvider()
    provider.search_in(['us-east-1', 'eu-central-1'])
    answers = provider.everywhere(provider.cloud, find)
    assert next(answers) == ['eu-central-1']
    with pytest.raises(ProviderError, match='us-east-1'):
        next(answers)


# -- who comes in -------------------------------------------------------------------------------


def test_rules_have_both_families_of_addresses():
    assert network.rule('tcp', 22, ['198.51.100.7', '2001:db8::7', '198.51.100.7/32']) == {
        'IpProtocol': 'tcp', 'FromPort': 22, 'ToPort': 22,
        'IpRanges': [{'CidrIp': '198.51.100.7/32'}],
        'Ipv6Ranges': [{'CidrIpv6': '2001:db8::7/128'}]}


@pytest.fixture
def echo(monkeypatch):
    """Answer HTTP on the loopback with the words of a list, one after the other."""
    said = []

    def answer(environ, start_response):
        status, words = said.pop(0)
        start_response(f'{status} {status}', [('Content-Length', str(len(words)))])
        return [words.encode()]

    with serving.serve(answer) as url:
        monkeypatch.setenv(address.CHECKIP_VARIABLE, url)
        monkeypatch.delenv(address.ADDRESS_VARIABLE, raising=False)
        yield url, said


def test_robot_address_is_asked_once_for_all_machines(echo):
    _, said = echo
    said.append((200, '198.51.100.7\n'))
    own = address.RobotAddress()
    assert own() == own() == '198.51.100.7/32'
    assert not said


@pytest.mark.parametrize('variable', address.BUNDLE_VARIABLES)
def test_robot_address_is_asked_through_a_proxy_that_reads_tls(tmp_path, monkeypatch, variable):
    """Its authority is where the clouds' libraries look for it, and not the system's."""
    certificate, key = tmp_path / 'crt', tmp_path / 'key'
    subprocess.run([
        'openssl', 'req', '-x509', '-newkey', 'rsa:2048', '-nodes', '-keyout', key, '-out',
        certificate, '-subj', '/CN=proxy', '-addext', 'subjectAltName=IP:127.0.0.1'],
        check=True, capture_output=True)
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(certificate, key)

    def answer(environ, start_response):
        start_response('200 OK', [])
        return [b'198.51.100.7']

    monkeypatch.delenv(address.ADDRESS_VARIABLE, raising=False)
    monkeypatch.setattr(address, 'has_ipv4', lambda: True)
    with serving.serve(answer, ssl_context=tls) as url:
        monkeypatch.setenv(address.CHECKIP_VARIABLE, url)
        with pytest.raises(ProviderError, match='CERTIFICATE_VERIFY_FAILED'):
            address.RobotAddress()()
        monkeypatch.setenv(variable, str(certificate))
        assert address.RobotAddress()() == '198.51.100.7/32'
        monkeypatch.setenv(variable, str(tmp_path / 'none'))
        with pytest.raises(ProviderError, match=address.ADDRESS_VARIABLE):
            address.RobotAddress()()


def test_a_robot_with_ipv6_is_let_in_by_that_too(echo, monkeypatch):
    _, said = echo
    monkeypatch.setattr(address, 'own_ipv6', lambda: '2001:db8::7/128')
    said.append((200, '198.51.100.7\n'))
    own = address.RobotAddress()
    assert own.with_ipv6([own()]) == ['198.51.100.7/32', '2001:db8::7/128']
    # what somebody has named is that alone, and nobody is nobody
    assert own.with_ipv6(['198.51.100.0/24']) == ['198.51.100.0/24']
    assert own.with_ipv6([]) == []


def test_robot_is_known_by_ipv6_only_without_ipv4(echo, monkeypatch):
    _, said = echo
    said += 2 * [(503, '')]
    monkeypatch.setattr(address, 'own_ipv6', lambda: '2001:db8::7/128')
    monkeypatch.setattr(address, 'has_ipv4', lambda: True)
    with pytest.raises(ProviderError, match=f'503.*{address.ADDRESS_VARIABLE}'):
        address.RobotAddress()()
    monkeypatch.setattr(address, 'has_ipv4', lambda: False)
    assert address.RobotAddress()() == '2001:db8::7/128'


@pytest.mark.parametrize('routed', [True, False])
def test_computer_with_a_route_has_ipv4(monkeypatch, routed):
    class Probe(socket.socket):
        def connect(self, far):
            assert ipaddress.ip_address(far[0]).is_global
            if not routed:
                raise OSError(errno.ENETUNREACH, 'no route')

    monkeypatch.setattr(address.socket, 'socket', Probe)
    assert address.has_ipv4() is routed


@pytest.mark.parametrize('url', ['checkip.example', 'http://a b/'])
def test_wrong_address_of_the_service_has_a_hint(monkeypatch, url):
    monkeypatch.setenv(address.CHECKIP_VARIABLE, url)
    monkeypatch.delenv(address.ADDRESS_VARIABLE, raising=False)
    monkeypatch.setattr(address, 'has_ipv4', lambda: True)
    with pytest.raises(ProviderError, match=address.ADDRESS_VARIABLE):
        address.RobotAddress()()


@pytest.mark.parametrize('own, known', [
    ('2606:4700::1', '2606:4700::1/128'), ('fd00::1', ''), ('2001:db8::1', '')])
def test_only_an_ipv6_address_that_others_see_is_one(monkeypatch, own, known):
    class Probe(socket.socket):
        def connect(self, far):
            assert ipaddress.ip_address(far[0]).is_global

        def getsockname(self):
            return own, 40000, 0, 0

    monkeypatch.setattr(address.socket, 'socket', Probe)
    assert address.own_ipv6() == known


def test_what_was_chosen_is_said_in_words():
    asked = spec(region='nearest', ec2_instance_type='cheapest')
    chosen = spec(region='eu-central-1', ec2_instance_type='t3a.medium')
    words = AWSProvider().choices
    assert words(asked, chosen) == ['t3a.medium in eu-central-1']
    chosen = spec(region='eu-central-1', ec2_instance_type='t3a.medium',
                  instance_types=['t3.medium', 'm7a.large'], regions=('eu-west-3', 'eu-west-2'))
    assert ', '.join(words(asked, chosen)) == (
        't3a.medium in eu-central-1, without room there t3.medium or m7a.large, '
        'in eu-west-3 or eu-west-2')


@pytest.mark.parametrize('answer', [(200, '<html>log in to this hotel</html>'), (503, '')])
def test_bad_answer_with_the_robot_address_has_a_hint(echo, answer):
    _, said = echo
    said.append(answer)
    with pytest.raises(ProviderError, match=address.ADDRESS_VARIABLE):
        address.RobotAddress()()


def test_the_robots_address_can_be_named(monkeypatch):
    monkeypatch.setenv(address.ADDRESS_VARIABLE, '2001:db8::7')
    assert address.RobotAddress()() == '2001:db8::7/128'
    monkeypatch.setenv(address.ADDRESS_VARIABLE, 'home')
    with pytest.raises(ConfigurationError, match='home'):
        address.RobotAddress()()


# -- boot ---------------------------------------------------------------------------------------


def config(**agent):
    return boot.cloud_config(
        name='planner', user='ubuntu', authorized_keys=['ssh-ed25519 AAAA robot'],
        host_key=one_time(TOKEN), agent_config=agent)


def test_the_one_time_host_key_is_a_key_pair_and_always_the_same(tmp_path):
    key = one_time(TOKEN)
    assert key == one_time(TOKEN) != one_time('another')
    assert 'PRIVATE' not in repr(key)
    file = tmp_path / 'key'
    file.write_text(key.private)
    file.chmod(0o600)
    shown = subprocess.run(['ssh-keygen', '-y', '-f', str(file)], capture_output=True, text=True)
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.split()[:2] == key.public.split()


def test_user_data_takes_many_keys_and_refuses_too_many():
    def data(keys):
        return boot.user_data({**config(**REQUEST.agent_config), 'ssh_authorized_keys': [
            f'ssh-ed25519 {base64.b64encode(os.urandom(51)).decode()} robot{n}'
            for n in range(keys)]})
    assert data(100)
    with pytest.raises(ProviderError) as refused:
        data(1000)
    assert 'fleet=' in refused.value.hint


def test_user_data_fits_and_is_the_same_for_the_same_request():
    def data():
        return boot.user_data(config(**REQUEST.agent_config))
    # room for keys
    assert len(data()) < boot.LIMIT // 2
    assert data() == data()
    text = gzip.decompress(data()).decode()
    assert text.startswith('#cloud-config\n')
    assert yaml.safe_load(text) == config(**REQUEST.agent_config)


def test_the_agent_is_armed_before_anything_else_runs():
    told = config(**REQUEST.agent_config)
    script, = (words[2] for words in told['bootcmd'])
    assert '"end_command": ["shutdown", "-h", "now"]' in script
    assert '"user": "ubuntu"' in script
    assert '--property=Restart=always --property=OOMPolicy=continue' in script
    assert 'apt-get' not in script
    assert told['ssh_keys']['ed25519_public'].split() == one_time(TOKEN).public.split()
    assert 'bootcmd' not in config()


@pytest.fixture
def booted(tmp_path):
    """Run what an instance runs at boot, in a folder instead of the root; ends what it starts."""
    def run(told, **variables):
        script = told['bootcmd'][0][2]
        for path in ('/opt/fogros2', '/run/fogros2', '/var/log', '/root/.ssh',
                     '/etc/needrestart', '/etc/apt', '/var/lib/systemd'):
            (tmp_path / path.lstrip('/')).parent.mkdir(parents=True, exist_ok=True)
            script = script.replace(path, f'{tmp_path}{path}')
        (tmp_path / 'var/log').mkdir(exist_ok=True)
        for name, text in {'systemd-run': 'exit 1', 'shutdown': f'echo "$@" >{tmp_path}/ended',
                           'getent': f'echo x:x:x:x:x:{tmp_path}/home:x'}.items():
            program = tmp_path / 'bin' / name
            program.parent.mkdir(exist_ok=True)
            program.write_text(f'#!/bin/sh\n{text}\n')
            program.chmod(0o755)
        environment = {'PATH': f'{tmp_path}/bin:{os.environ["PATH"]}', 'INSTANCE_ID': 'i-1',
                       **variables}
        child = subprocess.Popen(['sh', '-c', script], env=environment, start_new_session=True,
                                 stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        output, _ = child.communicate(timeout=20)
        assert child.returncode == 0, output
        return tmp_path

    yield run
    for found in Path('/proc').glob('[0-9]*/cmdline'):
        try:
            words = found.read_bytes()
        except OSError:
            continue
        if str(tmp_path).encode() in words and found.parent.name != str(os.getpid()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(found.parent.name), signal.SIGKILL)


def test_booted_instance_starts_the_agent_that_it_gets(booted):
    user = os.environ.get('USER') or subprocess.run(
        ['id', '-un'], capture_output=True, text=True).stdout.strip()
    told = boot.cloud_config(
        name='planner', user=user, authorized_keys=['ssh-ed25519 AAAA'], host_key=one_time(TOKEN),
        agent_config={'machine': 'planner', 'launch': 'l1', 'directory': '/run/fogros2',
                      'lifetime': 600.0})
    top = booted(told)
    program = top / 'opt/fogros2/agent.py'
    send = ['sh', '-ec', arming._SEND_FIRST, 'sh', str(program), str(len(agent_program()))]
    # a connection that is lost meanwhile
    assert subprocess.run(send, input=agent_program()[:-100], text=True).returncode
    assert not program.exists()
    subprocess.run(send, input=agent_program(), text=True, check=True)
    server = top / 'run/fogros2/agent.sock'
    wait_until(server.exists, timeout=60.0, what='the agent')
    answer = subprocess.run(
        [sys.executable, '-IS', str(program), 'connect', '--directory', str(server.parent)],
        input=b'{"id": 1, "command": "status"}\n', capture_output=True, timeout=20)
    status = json.loads(answer.stdout.splitlines()[0])
    assert status['ok'] and status['machine'] == 'planner', status
    assert oct((top / 'opt/fogros2/agent.json').stat().st_mode)[-3:] == '600'
    assert program.read_text() == agent_program()
    # a signal ends the agent in order; without another one, nothing would end the instance
    os.kill(status['pid'], signal.SIGTERM)
    wait_until(lambda: not Path(f"/proc/{status['pid']}").exists(), timeout=60, what='its end')
    wait_until(server.exists, timeout=60.0, what='another agent')


def test_other_version_of_the_agent_is_replaced(booted):
    top = booted(boot.cloud_config(
        name='planner', user=pwd.getpwuid(os.getuid()).pw_name, authorized_keys=[],
        host_key=one_time(TOKEN), agent_config={
            'machine': 'planner', 'directory': '/run/fogros2', 'lifetime': 600.0}))
    program, pid = top / 'opt/fogros2/agent.py', top / 'run/fogros2/agent.pid'

    def send(script, source, *words):
        subprocess.run(['sh', '-ec', script, 'sh', str(program), str(len(source)), *words],
                       input=source, text=True, check=True)

    def process():
        return pid.exists() and pid.read_text().strip()

    send(arming._SEND_FIRST, f'{agent_program()}#\n')
    older = wait_until(process, timeout=60.0, what='the agent')
    send(arming._REPLACE, agent_program(), older)
    assert program.read_text() == agent_program()
    wait_until(lambda: process() not in (False, '', older), timeout=60.0,
               what='the other agent')


def test_updates_of_the_system_do_not_restart_the_agent(booted):
    top = booted(config(machine='planner', directory='/run/fogros2'))
    settings = top / 'etc/needrestart/conf.d/fogros2.conf'
    assert settings.read_text() == '$nrconf{override_rc}{qr(^fogros2-agent)} = 0;\n'


@pytest.mark.parametrize(('on_exit', 'key', 'values'), [
    ('delete', 'APT::Periodic::Enable', ['0']),
    ('keep', 'Unattended-Upgrade::Package-Blacklist::',
     ['linux-', 'nvidia-', 'libnvidia-', 'docker', 'containerd'])])
def test_upgrades_take_nothing_from_running_nodes(booted, on_exit, key, values):
    """Neither apt's lock at the first boot, nor later the libraries of NVIDIA's driver."""
    top = booted(config(machine='planner', directory='/run/fogros2', on_exit=on_exit))
    settings = top / 'etc/apt/apt.conf.d/90fogros2'
    assert all(value in settings.read_text() for value in [key.rstrip(':'), *values])
    if shutil.which('apt-config'):
        dump = subprocess.run(['apt-config', '-c', settings, 'dump'], capture_output=True,
                              text=True, check=True).stdout.splitlines()
        assert {f'{key} "{value}";' for value in values} <= {*dump}


def test_nodes_keep_shared_memory_while_nobody_is_logged_in(booted):
    top = booted(config(machine='planner', directory='/run/fogros2'))
    assert (top / 'var/lib/systemd/linger/ubuntu').exists()


def test_keys_that_an_image_brings_along_are_taken_away_once(booted, tmp_path):
    keys = tmp_path / 'home/.ssh/authorized_keys'
    keys.parent.mkdir(parents=True)
    keys.write_text('of another robot')
    told = config(machine='planner', directory='/run/fogros2')
    booted(told)
    assert not keys.exists()
    keys.write_text('ours')
    booted(told)
    assert keys.read_text() == 'ours'


def test_recordings_that_an_image_brings_along_are_deleted_once(booted, tmp_path):
    recorded = tmp_path / 'home/fogros2-planner/recordings/run.mcap'
    users = [tmp_path / 'home' / name for name in ('fogros2-planner/notes', 'recordings/mine')]
    for path in (recorded, *users):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    told = config(machine='planner', directory='/run/fogros2')
    booted(told)
    assert not recorded.parent.exists() and all(path.exists() for path in users)
    recorded.parent.mkdir()
    recorded.touch()
    booted(told)
    assert recorded.exists()


def test_a_machine_that_boots_again_is_not_its_first_launchs(booted):
    """That one is over; later ones of the same robot came and went, by other ids."""
    told = config(machine='planner', launch='l1', directory='/run/fogros2')
    file = booted(told) / 'opt/fogros2/agent.json'
    program = file.with_name('agent.py')
    program.touch()
    assert json.loads(file.read_text())['launch'] == 'l1'
    kept = file.with_name('kept_until')
    assert json.loads(file.read_text())['kept_until'] == str(kept)
    kept.touch()
    booted(told)
    assert json.loads(file.read_text())['launch'] == '' and kept.exists() and program.exists()
    assert oct(file.stat().st_mode)[-3:] == '600'
    booted(told, INSTANCE_ID='i-2')
    assert json.loads(file.read_text())['launch'] == 'l1'
    assert not kept.exists() and not program.exists()


@pytest.mark.parametrize('user', ['root', 'no-such-user'])
def test_machine_that_gets_no_agent_ends(booted, user):
    """Its robot was killed before the first connection."""
    told = boot.cloud_config(
        name='planner', user=user, authorized_keys=['ssh-ed25519 AAAA'],
        host_key=one_time(TOKEN), agent_config={'machine': 'planner', 'boot_timeout': 1.0})
    top = booted(told)
    wait_until((top / 'ended').exists, timeout=60.0, what='the end')
    assert (top / 'ended').read_text() == '-h now\n'


@pytest.mark.parametrize(('answers', 'status'), [
    ([(200, 'token'), (404, '')], 1),
    ([(200, 'token'), (200, '{"action": "terminate", "time": "2026-01-01T00:02:00Z"}')], 0),
    ([(403, '')], 1)])
def test_the_notice_of_a_spot_instance_is_asked_for_with_a_token(echo, answers, status):
    url, said = echo
    said += answers
    *words, program = AWSProvider.capabilities.preemption_notice
    host, port = url.strip('/').removeprefix('http://').split(':')
    assert "('169.254.169.254', 80)" in program
    program = program.replace("('169.254.169.254', 80)", f"('{host}', {port})")
    result = subprocess.run([*words, program], capture_output=True, text=True, timeout=20)
    assert result.returncode == status, result.stderr
    assert ('terminate' in result.stdout) == (status == 0)
    assert not result.stderr


# -- errors -------------------------------------------------------------------------------------


def refused(code, message='', operation='RunInstances'):
    return failures.refused({'Error': {'Code': code, 'Message': message}}, operation,
                            "creating 'planner' in eu-central-1")


@pytest.mark.parametrize(('code', 'kind', 'words'), [
    ('ExpiredToken', PrerequisiteError, 'aws sso login'),
    ('SignatureDoesNotMatch', PrerequisiteError, 'clock'),
    ('InvalidSubnetID.NotFound', ConfigurationError, 'check subnet='),
    ('VcpuLimitExceeded', failures.AwsError, 'Service Quotas'),
    ('InsufficientInstanceCapacity', failures.AwsError, 'regions='),
    ('RequestLimitExceeded', failures.AwsError, 'fewer requests'),
    ('SomethingNew', failures.AwsError, 'as AWS said'),
    ('OptInRequired', PrerequisiteError, 'as AWS said'),
])
def test_every_known_refusal_says_what_to_do(code, kind, words):
    error = refused(code, 'as AWS\nsaid')
    assert isinstance(error, kind)
    assert "creating 'planner' in eu-central-1 failed" in str(error)
    assert words in str(error)
    assert code in str(error)
    assert '\n' not in str(error)


def test_type_outside_of_the_free_plan_has_a_remedy():
    error = refused('InvalidParameterCombination', 'The specified instance type is not eligible '
                    'for Free Tier. For a list of Free Tier instance types, run ...')
    assert 'm7i-flex.large' in error.hint


def test_machine_without_the_right_to_its_disks_key_names_it(monkeypatch):
    ended = instance('terminated', StateReason={
        'Code': 'Client.InternalError',
        'Message': 'Client.InternalError: Client error on launch'})
    monkeypatch.setattr(Ec2, 'get', lambda *words: instances.vm_of('eu-central-1', ended))
    with pytest.raises(ProviderError, match='Client error on launch') as caught:
        AWSProvider().reachable(machine_of(ended).id, name='planner', timeout=5.0)
    assert 'kms:CreateGrant' in caught.value.hint


def test_a_page_of_a_proxy_is_told_without_its_markup():
    page = '<!doctype html>\n<html><title>502</title>\n<h1>Bad gateway</h1>' + 'x' * 1000
    told = str(refused('502', page))
    assert '502 Bad gateway' in told and '<' not in told and len(told) < 400


DENIED = ('You are not authorized to perform this operation. User: arn:aws:iam::1:user/x is not '
          'authorized to perform: ec2:CreateTags on resource: arn:aws:ec2:* {}. Encoded '
          'authorization failure message: abc-DEF_123')


@pytest.mark.parametrize(('code', 'message', 'operation', 'action'), [
    ('UnauthorizedOperation', DENIED.format(
        'because no identity-based policy allows the ec2:CreateTags action'), 'RunInstances',
     'ec2:CreateTags'),
    ('UnauthorizedOperation', 'You are not authorized to perform this operation.', 'RunInstances',
     'ec2:RunInstances'),
    ('AccessDeniedException', 'no', 'GetParameter', 'ssm:GetParameter')])
def test_missing_action_of_a_policy_is_named(code, message, operation, action):
    error = refused(code, message, operation)
    assert error.args[0].endswith(f'the policy of these credentials does not allow {action}')
    assert f'add {action} to it' in error.hint and error.denied


@pytest.mark.parametrize('why', [
    'with an explicit deny in a service control policy: arn:aws:organizations::1:policy/o-1/'
    f'service_control_policy/p-{"1" * 200}',
    'because no permissions boundary allows the ec2:CreateTags action'])
def test_denial_of_another_policy_keeps_the_words_of_aws(why):
    error = refused('UnauthorizedOperation', DENIED.format(why))
    assert error.args[0].endswith(f'ec2:CreateTags on resource: arn:aws:ec2:* {why}.')
    assert 'ask who manages' in error.hint and error.denied


@pytest.mark.parametrize('name', ['AWS_ACCESS_KEY_ID', 'AWS_PROFILE'])
def test_whether_somebody_set_aws_up_is_seen_without_boto3(monkeypatch, tmp_path, name):
    for variable in login._VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    for variable in login._FILES:
        monkeypatch.setenv(variable, str(tmp_path / 'none'))
    assert not login.configured()
    monkeypatch.setenv(name, 'x')
    assert login.configured()
    monkeypatch.delenv(name)
    (tmp_path / 'none').write_text('[default]\n')
    assert login.configured()


# -- rights -------------------------------------------------------------------------------------


def test_policy_names_each_action_once_as_documented():
    document = iam.policy()
    listed = [action for statement in document['Statement'] for action in statement['Action']]
    assert sorted(set(listed)) == sorted(set(iam.ACTIONS))
    assert len(json.dumps(document, separators=(',', ':'))) < 6144  # what IAM takes
    told = (ROOT / 'doc' / 'aws.md').read_text()
    written = json.loads(re.search(r'```json\n(\{.*?\n\})\n```', told, re.DOTALL)[1])
    assert written == document


@pytest.mark.parametrize('code', ['ExpiredToken', 'RequestExpired'])
def test_running_launch_takes_renewed_credentials(code, monkeypatch, tmp_path):
    file, keys = tmp_path / 'credentials', []

    def answer(environ, start_response):
        keys.append(re.search('Credential=([^/]*)', environ['HTTP_AUTHORIZATION'])[1])
        expired = keys[-1] == 'OLD'
        body = (f'<ErrorResponse><Error><Code>{code}</Code></Error></ErrorResponse>' if expired
                else '<R><GetCallerIdentityResult><Account>7</Account>'
                     '</GetCallerIdentityResult></R>').encode()
        start_response('403 Forbidden' if expired else '200 OK', [
            ('Content-Type', 'text/xml'), ('Content-Length', str(len(body)))])
        return [body]

    def ask(account):
        return account.call('sts', 'eu-central-1', 'get_caller_identity', 'asking')['Account']

    def write(key):
        file.write_text(f'[default]\naws_access_key_id={key}\naws_secret_access_key=x\n')

    for name in ('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY', 'AWS_PROFILE'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('AWS_SHARED_CREDENTIALS_FILE', str(file))
    write('OLD')
    with serving.serve(answer) as url:
        monkeypatch.setenv('AWS_ENDPOINT_URL', url)
        account = clients.Account()
        with pytest.raises(PrerequisiteError, match=code):
            ask(account)
        write('NEW')
        assert (ask(account.having(None)), ask(account)) == ('7', '7')
    assert keys == ['OLD', 'OLD', 'OLD', 'NEW', 'NEW']


def test_unreachable_aws_is_one_line(hasty, monkeypatch):
    for name, value in {'AWS_ACCESS_KEY_ID': 'x', 'AWS_SECRET_ACCESS_KEY': 'x',
                        'FOGROS2_AWS_REGIONS': 'eu-central-1',
                        'AWS_ENDPOINT_URL': 'http://127.0.0.1:9'}.items():
        monkeypatch.setenv(name, value)
    provider = AWSProvider(Ec2(clients.Account()))
    for ask in (provider.answers, lambda: list(provider.find({}))):
        with pytest.raises(PrerequisiteError, match='AWS does not answer') as caught:
            ask()
        assert 'AWS_ENDPOINT_URL' in caught.value.hint
