# SPDX-License-Identifier: Apache-2.0
"""The AWS provider against Moto's EC2: what it asks, what it leaves, what it does when refused."""

from __future__ import annotations

import dataclasses
from decimal import Decimal
import gzip
import json
import re
import threading
import uuid

import boto3
from botocore.exceptions import ReadTimeoutError
from botocore.httpsession import URLLib3Session
import pytest

from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    MachineNotFound,
    PrerequisiteError,
    ProviderError,
)
from fogros2.model import CreateRequest, MachineSpec, MachineState
from fogros2.provider import TAG_DEPENDENCIES, TAG_NAME
from fogros2.provider.aws import images, instances
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.cloud import Ec2
from fogros2.provider.aws.failures import AwsError
from fogros2.provider.aws.provider import AWSProvider
from fogros2_features.images.keepers import image_keeper
from fogros2_features.volumes.keepers import volume_keeper
from fogros2_testing.provider_contract import PUBLIC_KEY
from rigs.ec2 import iam
from rigs.ec2.watched import ec2, left, NOTHING, Watched

pytestmark = pytest.mark.usefixtures('moto_aws')

HOME, AWAY = 'eu-central-1', 'us-east-1'
KEY = 'ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJ3Tq0CrBqXbWb0bqzPkGrjsvC7OxUD3yAyRIqLHTNN9'


@pytest.fixture
def aws() -> Watched:
    return Watched()


def ask(name='planner', *, dependencies='', on_exit='delete', **options):
    spec = MachineSpec(name, 'aws', {'ec2_instance_type': 't3.medium', **options}, on_exit=on_exit)
    return spec, CreateRequest(
        str(uuid.uuid4()), PUBLIC_KEY, {TAG_NAME: name, 'fogros2-launch': 'l1'}, 51820,
        agent_config={'machine': name, 'directory': '/run/fogros2'}, dependencies=dependencies)


def described(machine_id, region=HOME):
    return ec2(region).describe_instances(
        InstanceIds=[machine_id.split('/')[1]])['Reservations'][0]['Instances'][0]


def ports(machine_id, region=HOME):
    """Return who reaches a machine: 'tcp 22' -> networks."""
    group, = ec2(region).describe_security_groups(
        Filters=[{'Name': 'group-name', 'Values': [f'fogros2-{machine_id.split("/")[2]}']}]
    )['SecurityGroups']
    return {f'{rule["IpProtocol"]} {rule["FromPort"]}': sorted(
        entry.get('CidrIp') or entry['CidrIpv6'] for entry in rule['IpRanges']
        + rule['Ipv6Ranges']) for rule in group['IpPermissions']}


# -- a whole life -------------------------------------------------------------------------------


def test_ssh_rule_changes_and_named_networks_stay(aws):
    spec, request = ask(on_exit='keep', fleet=[KEY], ssh_from=['198.51.100.64/26'])
    machine_id = aws.provider.create(spec, request)
    assert ports(machine_id) == {
        'udp 51820': ['0.0.0.0/0', '::/0'], **dict.fromkeys(
            ('tcp 22', 'tcp 32768', 'udp 32768'), ['198.51.100.64/26'])}
    asked, = aws.asked('RunInstances')
    told = gzip.decompress(asked['UserData']).decode()
    assert json.loads(told.partition('\n')[2])['ssh_authorized_keys'] == [PUBLIC_KEY, KEY]
    for _ in range(2):
        aws.provider.allow(machine_id, 22, [])
        assert 'tcp 22' not in ports(machine_id)
    for sources in (['198.51.100.7/32', '2001:db8::8/128'], ['198.51.100.9/32']):
        AWSProvider().allow(machine_id, 22, sources)
        assert ports(machine_id)['tcp 22'] == sorted(['198.51.100.64/26', *sources])


def test_resources_of_a_machine_are_deleted_with_it(aws):
    spec, request = ask()
    machine_id = aws.provider.create(spec, request)
    attempt = machine_id.rsplit('/', 1)[1]
    tag = [{'Key': 'fogros2-attempt', 'Value': attempt}]
    ec2().create_volume(AvailabilityZone=f'{HOME}a', Size=8, TagSpecifications=[
        {'ResourceType': 'volume', 'Tags': tag}])
    others = ec2().create_volume(AvailabilityZone=f'{HOME}a', Size=8)['VolumeId']
    aws.provider.destroy(machine_id)
    assert left() == {**NOTHING, 'volumes': [others]}


def test_an_instance_that_is_not_ours_is_never_ended(aws):
    image = ec2().describe_images()['Images'][0]['ImageId']
    theirs = ec2().run_instances(
        ImageId=image, MinCount=1, MaxCount=1)['Instances'][0]['InstanceId']
    aws.provider.destroy(f'aws:{HOME}/{theirs}/0123456789abcdef')
    assert left()['instances'] == [theirs]
    assert not list(aws.provider.find({}))


def test_a_region_that_is_closed_to_us_hides_no_other(aws, monkeypatch):
    machine_id = aws.provider.create(*ask())
    monkeypatch.delenv('FOGROS2_AWS_REGIONS')
    aws.refuse('DescribeInstances', 'UnauthorizedOperation')
    found = [m.id for m in aws.provider.find({})]
    assert found in ([machine_id], [])  # it may be its own region that said no
    aws.provider.search_in([HOME])
    aws.refuse('DescribeInstances', 'UnauthorizedOperation')
    with pytest.raises(AwsError, match='ec2:DescribeInstances'):
        list(aws.provider.find({}))


# -- images -------------------------------------------------------------------------------------


def test_image_is_baked_reused_and_deleted_with_snapshots(aws):
    spec, request = ask()
    machine_id = aws.provider.create(spec, request)
    first = image_keeper(aws.provider).bake(machine_id, 'planner', 'abcd')
    again = image_keeper(aws.provider).bake(machine_id, 'planner: new', 'abcd')
    assert aws.asked('CreateImage')[0]['NoReboot'] is True
    found = {image.id: image for image in image_keeper(aws.provider).images()}
    assert set(found) == {first, again}
    assert found[first].name == 'planner'
    assert found[first].dependencies == 'abcd'
    assert found[first].state == 'available'
    assert found[first].region == HOME
    ours = {snapshot['SnapshotId'] for snapshot in ec2().describe_snapshots(
        OwnerIds=['self'])['Snapshots'] if 'fogros2-baked' in instances.tags_of(snapshot)}
    assert ours
    for dependencies, ours_taken in (('abcd', True), ('other', False), ('', False)):
        new = aws.provider.create(*ask(f'm{dependencies}', dependencies=dependencies))
        assert (f'aws:{HOME}/{described(new)["ImageId"]}' in found) is ours_taken
        tags = aws.provider.describe(new).tags
        assert tags.get(TAG_DEPENDENCIES, '') == dependencies
    image_keeper(aws.provider).delete_image(first)
    image_keeper(aws.provider).delete_image(first)
    image_keeper(aws.provider).delete_image(again)
    assert not list(image_keeper(aws.provider).images())
    kept = {entry['SnapshotId']
            for entry in ec2().describe_snapshots(OwnerIds=['self'])['Snapshots']}
    assert not ours & kept


def test_image_has_the_driver_of_its_machine(aws):
    plain = aws.provider.create(*ask())
    seeing = aws.provider.create(*ask('seer', ec2_instance_type='g5.xlarge'))
    baked = {}
    for machine_id in (plain, seeing):
        image = image_keeper(aws.provider).bake(machine_id, 'planner', 'abcd')
        baked[machine_id] = image.rpartition('/')[2]
        # no image fits the other kind of machine, or its own does, though it is older
        for kind, like in (('t3.large', plain), ('g5.xlarge', seeing)):
            new = aws.provider.create(*ask(
                f'{len(baked)} {kind}', dependencies='abcd', ec2_instance_type=kind))
            taken = described(new)['ImageId']
            assert taken == baked[like] if like in baked else taken not in baked.values()


def test_image_leaves_volumes_out(aws):
    machine_id = aws.provider.create(*ask())
    volume = ec2().create_volume(AvailabilityZone=f'{HOME}a', Size=200)['VolumeId']
    ec2().attach_volume(VolumeId=volume, InstanceId=machine_id.split('/')[1], Device='/dev/sdf')
    image = image_keeper(aws.provider).bake(machine_id, 'planner', 'abcd')
    (request,) = aws.asked('CreateImage')
    assert request['BlockDeviceMappings'] == [{'DeviceName': '/dev/sdf', 'NoDevice': ''}]
    (entry,) = ec2().describe_images(ImageIds=[image.rpartition('/')[2]])['Images']
    assert len(entry['BlockDeviceMappings']) == 1


def test_an_image_of_somebody_else_is_not_deleted(aws):
    theirs = ec2().describe_images(Owners=['self'])['Images'][0]['ImageId']
    with pytest.raises(ProviderError, match='no image of FogROS2'):
        image_keeper(aws.provider).delete_image(f'aws:{HOME}/{theirs}')
    with pytest.raises(MachineNotFound):
        image_keeper(aws.provider).delete_image('planner')


def test_gpu_and_arm_types_get_their_own_images(aws):
    parameters = {'g5.xlarge': images.DEEP_LEARNING['x86_64'],
                  'm6g.large': images.UBUNTU['arm64']}
    for number, (kind, parameter) in enumerate(parameters.items()):
        made = aws.provider.create(*ask(f'm{number}', ec2_instance_type=kind))
        told = boto3.client('ssm', HOME).get_parameter(Name=parameter)['Parameter']['Value']
        assert described(made)['ImageId'] == told


# -- bad input, before anything is made ---------------------------------------------------------


@pytest.mark.parametrize(('options', 'words'), [
    ({'ec2_instance_type': 't9.medium'}, 'ros2 fog price'),
    ({'ami_image': 'ami-00000000'}, 'an AMI belongs to one region'),
    ({'subnet': 'subnet-00000000'}, 'check subnet='),
    ({'ami_image': 'of arm64'}, 'arm64 processors, and t3.medium has x86_64'),
])
def test_missing_resource_is_named_before_creation(aws, options, words):
    if options.get('ami_image') == 'of arm64':
        options = {'ami_image': boto3.client('ssm', HOME).get_parameter(
            Name=images.UBUNTU['arm64'])['Parameter']['Value']}
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        aws.provider.create(*ask(**options))
    assert left() == NOTHING
    assert not aws.asked('CreateSecurityGroup')


@pytest.mark.parametrize(('options', 'architecture'), [
    ({}, 'x86_64'),
    ({'ec2_instance_type': 'm6g.large'}, 'aarch64'),
    ({'ec2_instance_type': 'g5.xlarge', 'instance_types': ['m6g.large']}, ''),
])
def test_architecture_is_known_from_the_instance_type(aws, options, architecture):
    spec, _ = ask(**options)
    assert aws.provider.architecture(aws.provider.resolve(spec)) == architecture
    assert not aws.asked('CreateSecurityGroup')


def test_no_credentials_and_no_region_are_found_by_the_check(monkeypatch, aws):
    spec, _ = ask()
    for name in ('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY'):
        monkeypatch.delenv(name)
    with pytest.raises(PrerequisiteError, match='no AWS credentials'):
        AWSProvider().check(spec)
    monkeypatch.setenv('AWS_ACCESS_KEY_ID', 'x')
    with pytest.raises(PrerequisiteError, match='incomplete'):
        AWSProvider().check(spec)
    monkeypatch.setenv('AWS_SECRET_ACCESS_KEY', 'x')
    monkeypatch.delenv('AWS_DEFAULT_REGION')
    with pytest.raises(ConfigurationError, match="region='nearest'"):
        AWSProvider().check(spec)
    monkeypatch.setenv('AWS_PROFILE', 'robots')
    with pytest.raises(PrerequisiteError, match='robots'):
        AWSProvider().check(spec)


def test_a_price_above_the_cap_is_refused(aws):
    spec, _ = ask(max_price=0.01)
    with pytest.raises(ConfigurationError, match=r'0\.0416 US dollars'):
        aws.provider.resolve(spec)
    assert not aws.asked('RunInstances')
    cheap, _ = ask(max_price=0.05)
    assert aws.provider.resolve(cheap).options['region'] == HOME


# -- refused ------------------------------------------------------------------------------------


def test_failed_undo_does_not_stop_the_other_undos(aws):
    aws.refuse('RunInstances', 'InvalidParameterValue')
    aws.refuse('DeleteKeyPair', 'UnauthorizedOperation')
    with pytest.raises(AwsError, match='as AWS said') as caught:
        aws.provider.create(*ask())
    assert left()['groups'] == []
    assert len(left()['keys']) == 1
    failure, = caught.value.undo_failures
    assert str(failure).startswith(
        "the login key of 'planner' in eu-central-1 may be left: deleting the login key")
    assert 'ec2:DeleteKeyPair' in str(failure) and 'ros2 fog gc' in str(failure)
    assert caught.value.refused


def test_an_instance_that_may_be_left_is_looked_for_again(aws):
    aws.refuse('RunInstances', 'InvalidParameterValue')
    aws.refuse('DescribeInstances', None, 'UnauthorizedOperation')
    with pytest.raises(AwsError) as caught:
        aws.provider.create(*ask())
    assert [str(failure).partition(' of ')[0] for failure in caught.value.undo_failures] == [
        'the instance']
    assert not caught.value.refused
    assert left() == NOTHING


def test_leftovers_of_a_full_region_are_reported(aws):
    aws.refuse('RunInstances', *['InsufficientInstanceCapacity'] * 4)
    aws.refuse('DeleteKeyPair', 'UnauthorizedOperation')
    machine_id = aws.provider.create(*ask(region=HOME, regions=[AWAY]))
    machine = aws.provider.reachable(
        machine_id, name='planner', timeout=60.0)
    assert machine.note.startswith("the login key of 'planner' in eu-central-1 may be left")


# -- cancelled ----------------------------------------------------------------------------------


class InPause(threading.Event):
    """An event that is set in the pause after a throttled call, as by a Ctrl-C."""

    def __init__(self, aws):
        super().__init__()
        self._aws = aws

    def wait(self, timeout=None):
        if self._aws.sent:
            self.set()
        return super().wait(0.01)


def test_the_end_of_a_launch_gets_through_a_throttled_call(aws):
    aws.refuse('RunInstances', *['RequestLimitExceeded'] * 40)
    spec, request = ask()
    aws.provider.cancel = InPause(aws)
    with pytest.raises(Cancelled) as caught:
        aws.provider.create(spec, request)
    assert aws.sent == ['RequestLimitExceeded']
    assert caught.value.refused and not caught.value.undo_failures
    assert left() == NOTHING


def test_instance_in_creation_is_known_at_the_launchs_end(aws):
    """Its request was on its way; an answer that comes soon is the better one."""
    spec, request = ask()
    cancel = threading.Event()

    def sent(event_name, **words):
        if event_name.endswith('.RunInstances'):
            cancel.set()

    # after what looks whether the launch has ended
    aws.account.client('ec2', HOME).meta.events.register_last('before-send', sent)
    aws.provider.cancel = cancel
    machine_id = aws.provider.create(spec, request)
    assert left()['instances'] == [machine_id.split('/')[1]]


# -- taken over ---------------------------------------------------------------------------------


def test_reused_machine_follows_the_settings_of_its_launch(aws):
    spec, request = ask(on_exit='stop')
    machine_id = aws.provider.create(spec, request)
    instance = machine_id.split('/')[1]

    def behaviour():
        return ec2().describe_instance_attribute(
            InstanceId=instance, Attribute='instanceInitiatedShutdownBehavior')[
                'InstanceInitiatedShutdownBehavior']['Value']

    assert behaviour() == 'stop'
    tags = {'fogros2-expires': '2000000000', 'fogros2-on-exit': 'delete'}
    aws.provider.adopt(machine_id, dataclasses.replace(spec, on_exit='delete'), tags)
    assert behaviour() == 'terminate'
    assert tags.items() <= aws.provider.describe(machine_id).tags.items()
    aws.provider.stop(machine_id)
    aws.provider.adopt(machine_id, spec, {'fogros2-on-exit': 'stop'})
    assert behaviour() == 'stop'


def test_kept_spot_machine_is_reused(aws):
    spec, request = ask(on_exit='keep', spot=True)
    machine_id = aws.provider.create(spec, request)
    # EC2 refuses to change some attributes of spot instances; this one is 'terminate' anyway
    aws.refuse('ModifyInstanceAttribute', 'UnsupportedOperation')
    aws.provider.adopt(machine_id, spec, {'fogros2-launch': 'l2'})
    assert aws.provider.describe(machine_id).tags['fogros2-launch'] == 'l2'
    assert aws.sent == ['UnsupportedOperation']


def test_a_group_in_use_is_deleted_as_soon_as_it_is_free(aws):
    machine_id = aws.provider.create(*ask())
    aws.refuse('DeleteSecurityGroup', 'DependencyViolation', 'DependencyViolation')
    aws.provider.destroy(machine_id)
    assert left() == NOTHING
    assert aws.count()['ec2:DeleteSecurityGroup'] == 3


@pytest.mark.parametrize(('operation', 'code'), [
    ('AuthorizeSecurityGroupIngress', 'InvalidGroup.NotFound'),
    ('RunInstances', 'InvalidGroup.NotFound'), ('RunInstances', 'InvalidKeyPair.NotFound')])
def test_new_group_or_key_unknown_to_ec2_yet_is_waited_for(aws, operation, code):
    aws.refuse(operation, code)
    machine_id = aws.provider.create(*ask())
    assert aws.sent == [code]
    aws.provider.destroy(machine_id)
    assert left() == NOTHING


def test_new_group_unknown_to_ec2_yet_is_deleted(aws):
    aws.refuse('RunInstances', 'InvalidParameterValue')
    aws.refuse('DeleteSecurityGroup', 'InvalidGroup.NotFound')
    with pytest.raises(AwsError, match='InvalidParameterValue') as caught:
        aws.provider.create(*ask())
    assert left() == NOTHING and not caught.value.undo_failures


def test_machine_unknown_to_ec2_yet_is_deleted(aws):
    machine_id = aws.provider.create(*ask())
    aws.refuse('TerminateInstances', 'InvalidInstanceID.NotFound')
    aws.provider.destroy(machine_id)
    assert left() == NOTHING
    # and then it is known to be gone, at once
    aws.provider.destroy(machine_id)
    assert aws.count()['ec2:TerminateInstances'] == 2


def test_no_room_in_a_zone_leads_to_the_next(aws):
    aws.refuse('RunInstances', 'InsufficientInstanceCapacity', 'Unsupported')
    aws.provider.create(*ask())
    tries = aws.asked('RunInstances')
    subnets = [params['NetworkInterfaces'][0].get('SubnetId') for params in tries]
    assert subnets[0] is None and len(set(subnets)) == 3
    assert len({params['ClientToken'] for params in tries}) == 3
    # EC2 says it with status 500, and isn't asked the same again
    assert aws.sent == ['InsufficientInstanceCapacity', 'Unsupported']
    assert len(left()['groups']) == 1


def test_spot_machine_costs_no_more_than_is_counted(aws, monkeypatch):
    zones = {f'{HOME}a': Decimal('0.35'), f'{HOME}b': Decimal('0.60')}
    monkeypatch.setattr('fogros2.provider.aws.prices.Ec2Prices.spot_prices',
                        lambda *words: {'t3.medium': zones})
    spec, request = ask(spot=True)
    assert aws.provider.cost_per_hour(spec) == Decimal('0.60')
    aws.refuse('RunInstances', 'InsufficientInstanceCapacity')
    machine_id = aws.provider.create(spec, request)
    assert aws.provider.describe(machine_id).cost_per_hour == Decimal('0.60')
    # the dearest zone is above the limit, and the others are tried
    capped = aws.provider.create(*ask('mapper', spot=True, max_price=0.4))
    assert aws.provider.describe(capped).cost_per_hour == Decimal('0.35')


def test_next_type_keeps_to_the_price_cap(aws, monkeypatch):
    prices = {'t3.medium': Decimal('0.04'), 't3.xlarge': Decimal('0.17')}
    monkeypatch.setattr(aws.provider, '_price', lambda region, kind, *more: prices.get(kind))
    aws.refuse('RunInstances', 'VcpuLimitExceeded', 'VcpuLimitExceeded')
    # the price of t3.large nobody knows, that of t3.xlarge is above the cap
    with pytest.raises(AwsError):
        aws.provider.create(*ask(instance_types=['t3.large', 't3.xlarge'], max_price=0.1))
    assert [params['InstanceType'] for params in aws.asked('RunInstances')] == ['t3.medium']
    assert left() == NOTHING
    aws.refuse('RunInstances', 'VcpuLimitExceeded')
    machine_id = aws.provider.create(*ask('other', instance_types=['t3.large']))
    found = aws.provider.describe(machine_id)
    assert (found.kind, found.cost_per_hour) == ('t3.large', None)


def test_types_that_a_region_lacks_are_skipped(aws):
    machine_id = aws.provider.create(*ask(
        ec2_instance_type='t9.medium', instance_types=['t3.large', 't9.large']))
    assert aws.provider.describe(machine_id).kind == 't3.large'
    with pytest.raises(ConfigurationError, match=r't9.medium or t9.large in eu-central-1 failed'):
        aws.provider.create(*ask('mapper', ec2_instance_type='t9.medium',
                                 instance_types=['t9.large']))


def test_nearest_region_and_its_neighbours_have_a_value(aws, monkeypatch):
    asked = []
    monkeypatch.setattr(AWSProvider, 'nearest',
                        lambda self, among=(): asked.append(among) or HOME)

    def resolved(**options):
        spec = aws.provider.resolve(ask(region='nearest', **options)[0])
        return spec.options['region'], spec.options['regions']

    assert resolved() == (HOME, ['eu-west-3', 'eu-west-2'])
    assert resolved(regions=[AWAY]) == (HOME, [AWAY])
    # the neighbour eu-west-3 has no image, so the launch doesn't go on there
    assert resolved(ami_image={HOME: 'ami-1', 'eu-west-2': 'ami-2', AWAY: 'ami-3'}) == (
        HOME, ['eu-west-2'])
    assert asked[-1] == [HOME, 'eu-west-2', AWAY]


@pytest.mark.parametrize('where', [{'region': AWAY}, {'region': HOME, 'regions': [AWAY]}, {
    'region': 'nearest', 'regions': [AWAY]}])
def test_a_region_without_a_value_is_an_error_before_anything(aws, where):
    spec, _ = ask(**where, ami_image={HOME: 'ami-1', 'eu-west-1': 'ami-2'})
    with pytest.raises(ConfigurationError, match=(
            f'ami_image has no value for the region {AWAY}')) as caught:
        aws.provider.check(spec)
    assert caught.value.hint == f'add one, or choose the region among {HOME}, eu-west-1'
    assert aws.calls == []


def test_each_region_gets_its_own_image_and_type(aws):
    """The first has no room, and the launch goes on with what is for the second."""
    here, there = [boto3.client('ssm', region).get_parameter(
        Name=images.UBUNTU['x86_64'])['Parameter']['Value'] for region in (HOME, AWAY)]
    assert here != there
    aws.refuse('RunInstances', *['InsufficientInstanceCapacity'] * 4)
    machine_id = aws.provider.create(*ask(
        region=HOME, regions=[AWAY], ami_image={HOME: here, AWAY: there},
        ec2_instance_type={HOME: 't3.medium', AWAY: 't3.large'}))
    assert machine_id.startswith(f'aws:{AWAY}/')
    asked = [(words['ImageId'], words['InstanceType']) for words in aws.asked('RunInstances')]
    assert asked[0] == (here, 't3.medium') and asked[-1] == (there, 't3.large')


def test_the_same_request_is_the_same_to_the_byte(aws):
    """EC2 knows a request again by its token only if everything else is the same too."""
    spec, request = ask()
    aws.refuse('RunInstances', 'InternalError')
    with pytest.raises(AwsError):
        aws.provider.create(spec, request)
    aws.provider.create(spec, request)
    first, second = aws.asked('RunInstances')
    assert first.pop('NetworkInterfaces') != second.pop('NetworkInterfaces')  # another group
    assert first == second


def test_an_attempt_that_was_cut_short_is_taken_up_where_it_was(aws):
    """The process was killed between the group, the key and the instance."""
    spec, request = ask()
    aws.refuse('RunInstances', 'InternalError')
    aws.refuse('DeleteKeyPair', 'InternalError')
    aws.refuse('DeleteSecurityGroup', 'InternalError')
    with pytest.raises(AwsError):
        aws.provider.create(spec, request)
    assert len(left()['groups']) == len(left()['keys']) == 1
    machine_id = AWSProvider().create(spec, request)
    assert len(left()['groups']) == len(left()['keys']) == 1
    AWSProvider().destroy(machine_id)
    assert left() == NOTHING


def test_a_new_instance_that_ec2_does_not_know_yet_is_pending(aws):
    machine_id = aws.provider.create(*ask())
    aws.refuse('DescribeInstances', 'InvalidInstanceID.NotFound')
    assert aws.provider.describe(machine_id).state is MachineState.PENDING
    aws.refuse('DescribeInstances', 'InvalidInstanceID.NotFound')
    with pytest.raises(MachineNotFound):
        AWSProvider(Ec2(Account(aws.account.session()))).describe(machine_id)


def test_a_machine_that_ends_while_it_comes_up_says_why(aws):
    machine_id = aws.provider.create(*ask())
    ec2().terminate_instances(InstanceIds=[machine_id.split('/')[1]])
    with pytest.raises(ProviderError, match='ended while it was coming up: Client.User'):
        aws.provider.reachable(machine_id, name='planner', timeout=20)


# -- lost answers -------------------------------------------------------------------------------


@pytest.fixture
def lose(aws, monkeypatch):
    """Lose the answer to an action, and refuse its repetition with a code."""
    def lose(action, code):
        def sent(own, request):
            answer = send(own, request)
            if f'Action={action}&' in str(request.body):
                aws.refuse(action, code)
                raise ReadTimeoutError(endpoint_url=request.url)
            return answer

        send = URLLib3Session.send
        monkeypatch.setattr(URLLib3Session, 'send', sent)

    return lose


def test_image_without_an_answer_is_made_once(aws, lose):
    machine_id = aws.provider.create(*ask())
    lose('CreateImage', 'InvalidAMIName.Duplicate')
    made = image_keeper(aws.provider).bake(machine_id, 'planner', 'abcd')
    assert [image.id for image in image_keeper(aws.provider).images()] == [made]
    image_keeper(aws.provider).delete_image(made)


def test_volume_without_an_answer_is_attached_and_detached(aws, lose):
    machine_id = aws.provider.create(*ask())
    keeper = volume_keeper(aws.provider)
    lose('AttachVolume', 'VolumeInUse')
    keeper.attach(machine_id, 'models', 60)
    (volume,) = keeper.volumes()
    assert volume.user == machine_id.split('/')[1]
    lose('DetachVolume', 'IncorrectState')
    keeper.detach(machine_id, 'models')
    assert [volume.user for volume in keeper.volumes()] == ['']


def test_group_without_an_answer_is_waited_for(aws, lose, monkeypatch):
    groups, lagging = Ec2._groups, [[]]
    monkeypatch.setattr(Ec2, '_groups', lambda *words: (
        lagging.pop() if lagging else groups(*words)))
    lose('CreateSecurityGroup', 'InvalidGroup.Duplicate')
    machine_id = aws.provider.create(*ask())
    assert not lagging
    aws.provider.destroy(machine_id)
    assert left() == NOTHING


# -- rights -------------------------------------------------------------------------------------


def test_policy_has_exactly_the_calls_that_are_made(aws):
    provider = aws.provider
    provider.answers()
    machine_id = provider.create(*ask(on_exit='stop'))
    attempt = machine_id.rsplit('/', 1)[1]
    tag = [{'Key': 'fogros2-attempt', 'Value': attempt}]
    ec2().create_volume(AvailabilityZone=f'{HOME}a', Size=8, TagSpecifications=[
        {'ResourceType': 'volume', 'Tags': tag}])
    provider.allow(machine_id, 22, [])
    provider.pin(machine_id, KEY)
    provider.stop(machine_id)
    provider.adopt(machine_id, ask()[0], {})
    provider.start(machine_id)
    assert not provider.reclaims(machine_id)
    image = image_keeper(provider).bake(machine_id, 'planner', 'abcd')
    list(image_keeper(provider).images())
    image_keeper(provider).delete_image(image)
    provider.tidy()
    provider.destroy(machine_id)
    aws.refuse('RunInstances', 'InsufficientInstanceCapacity')
    provider.destroy(provider.create(*ask()))
    provider.search_in(['all'])
    list(provider.find({}))
    called = set(aws.count())
    assert called <= {*iam.ACTIONS, *iam.FREE}
    assert {*iam.ACTIONS} - called == {*iam.PRICES, *iam.VOLUMES}
