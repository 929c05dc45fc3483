# SPDX-License-Identifier: Apache-2.0
"""Tags, labels and annotations that commit 326363e wrote are still read."""

from __future__ import annotations

import json
from pathlib import Path

import boto3
import pytest

from fogros2.model import MachineSpec, MachineState
from fogros2.provider.aws.instances import tag_list
from fogros2.provider.aws.provider import AWSProvider
from fogros2.provider.container import engine, machine
from fogros2.provider.kubernetes import names

RECORDED = json.loads(Path(__file__).with_name('tags_326363e.json').read_text())
REGION = 'eu-central-1'


@pytest.fixture
def instance(moto_aws):
    """Return the id of an instance with its group and key, as 326363e has created them."""
    ec2 = boto3.client('ec2', REGION)
    record = RECORDED['aws']
    tags = tag_list(record['tags'])
    group = ec2.create_security_group(
        GroupName=record['group'], Description='FogROS2', TagSpecifications=[
            {'ResourceType': 'security-group', 'Tags': tags}])['GroupId']
    ec2.create_key_pair(KeyName=record['key'])
    image = ec2.describe_images()['Images'][0]['ImageId']
    found = ec2.run_instances(
        ImageId=image, InstanceType='t3.large', MinCount=1, MaxCount=1, KeyName=record['key'],
        SecurityGroupIds=[group], TagSpecifications=[
            {'ResourceType': 'instance', 'Tags': tags}])['Instances'][0]['InstanceId']
    return f'aws:{REGION}/{found}/{record["attempt"]}'


def remains():
    ec2 = boto3.client('ec2', REGION)
    groups = ec2.describe_security_groups()['SecurityGroups']
    return ([key['KeyName'] for key in ec2.describe_key_pairs()['KeyPairs']],
            [group['GroupName'] for group in groups if group['GroupName'] != 'default'])


def test_ec2_instance_is_listed_and_described(instance):
    provider = AWSProvider()
    found, = provider.find({'fogros2-name': 'aws-kept'})
    assert (found.id, found.name, found.state) == (instance, 'aws-kept', MachineState.RUNNING)
    tags = RECORDED['aws']['tags']
    assert dict(found.tags) == tags
    assert found.shell.host_key == tags['fogros2-host-key']
    assert str(found.cost_per_hour) == tags['fogros2-price-per-hour']
    assert provider.describe(instance) == found


def test_ec2_instance_is_adopted_and_opened(instance):
    provider = AWSProvider()
    spec = MachineSpec('aws-kept', 'aws', on_exit='stop')
    provider.adopt(instance, spec, {'fogros2-launch': 'ffffff'})
    assert provider.describe(instance).tags['fogros2-launch'] == 'ffffff'
    provider.allow(instance, 22, [provider.robot_address()])
    group, = boto3.client('ec2', REGION).describe_security_groups(
        GroupNames=[RECORDED['aws']['group']])['SecurityGroups']
    networks = [one['CidrIp'] for one in group['IpPermissions'][0]['IpRanges']]
    assert sorted(networks) == ['198.51.100.0/24', '198.51.100.7/32']


def test_ec2_instance_is_deleted_with_group_and_key(instance):
    AWSProvider().destroy(instance)
    assert remains() == ([], [])


def test_group_of_an_ended_instance_is_collected(instance, monkeypatch):
    boto3.client('ec2', REGION).terminate_instances(InstanceIds=[instance.split('/')[1]])
    assert AWSProvider().tidy() == [f"firewall and key of 'aws-kept' in {REGION}"]
    assert remains() == ([], [])


def test_container_is_a_machine():
    labels = RECORDED['container']['labels']
    found = machine.machine_of(engine.named('podman'), {
        'Id': '0123456789ab', 'Created': '2026-11-19T00:00:00Z', 'Name': 'x',
        'State': {'Status': 'running'}, 'NetworkSettings': {'Networks': {}},
        'Config': {'Labels': labels, 'Image': ''}}, 'ssh-ed25519 AAAA')
    assert (found.name, found.id) == (
        'container-kept', f'podman:0123456789ab:{labels["fogros2-token"]}')
    assert found.tags == {key: labels[key] for key in found.tags}
    assert found.tags['fogros2-on-exit'] == 'keep'


def test_pod_has_its_tags():
    job = {'metadata': RECORDED['kubernetes']['metadata']}
    tags = names.tags_of(job)
    assert tags['fogros2-name'] == 'kubernetes-kept' and tags['fogros2-on-exit'] == 'keep'
    assert names.annotation(job, names.LOGIN) == 'fog'
    selected = names.wanted({'fogros2-name': 'kubernetes-kept'})
    assert selected.items() <= job['metadata']['labels'].items()
