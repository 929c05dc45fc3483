# SPDX-License-Identifier: Apache-2.0
"""EC2 instances and pods as launch files write them, and what is found out later for them."""

from __future__ import annotations

from decimal import Decimal
from types import SimpleNamespace

from launch import LaunchContext
from launch.substitutions import LaunchConfiguration
import pytest

import fogros2
from fogros2 import AWSCloudInstance, KubeInstance
from fogros2.describe import keywords, overrides, values
from fogros2.errors import ConfigurationError
from fogros2.provider.aws.provider import AWSProvider
from fogros2.provider.machine_types import MachineType
from fogros2_features.prices.market import CloudSeller
from fogros2_features.prices.offers import Offer, Offers, wants


@pytest.fixture
def context():
    return LaunchContext()


def options(machine, context):
    return machine.spec(context).options


def test_unset_options_are_left_out(context):
    for kind, provider in ((AWSCloudInstance, 'aws'), (KubeInstance, 'kubernetes')):
        spec = kind(name='cloud', ros_workspace='').spec(context)
        assert (spec.provider, spec.options, spec.features) == (provider, {}, {})


def test_everything_that_an_instance_takes(context):
    said = {
        'ami_image': 'ami-0123', 'region': 'nearest', 'ec2_instance_type': 'cheapest',
        'disk_size': 60, 'spot': True, 'arch': 'arm64', 'min_cpu': 8, 'min_memory_gb': 32,
        'cpu_type': 'aws', 'gpu': 1, 'gpu_memory_gb': 16, 'max_price': 0.5,
        'iam_instance_profile': 'robot', 'subnet': 'subnet-1',
        'tags': {'team': 'red'}, 'regions': ['eu-west-1'], 'instance_types': ['t3.large'],
        'user': 'ubuntu', 'ssh_from': ['198.51.100.0/24'], 'fleet': ['ssh-ed25519 AAAA robot']}
    spec = AWSCloudInstance(
        name='cloud', on_interrupt='robot', on_exit='keep', lifetime='2h', **said).spec(context)
    assert spec.options == said
    assert (spec.features, spec.on_exit, spec.lifetime) == (
        {'replacement': {'on_interrupt': 'robot'}}, 'keep', 7200)
    # the provider takes them all
    from fogros2.provider.aws.options import Options
    Options.parse({key: value for key, value in said.items()
                   if key not in ('ami_image', 'subnet')})


def test_everything_that_a_pod_takes(context):
    said = {
        'container_image': 'ros:jazzy', 'zone': 'b', 'mcpu': 500, 'mb': 512,
        'namespace': 'robots', 'context': 'lab', 'gpus': 1, 'gpu_resource': 'amd.com/gpu',
        'node_selector': {'gpu': 'yes'},
        'tolerations': [{'key': 'gpu', 'operator': 'Exists', 'tolerationSeconds': 5}],
        'runtime_class': 'nvidia', 'image_pull_secrets': ['registry'],
        'service_account': 'robot', 'expose': 'node_port', 'robot_host': '198.51.100.1',
        'user': 'me', 'env': {'A': '1'}, 'annotations': {'a/b': 'c'}}
    assert options(KubeInstance(name='pod', **said), context) == said
    from fogros2.provider.kubernetes.options import Options
    Options.parse(said)


def test_what_fogros2_has_by_position(context):
    assert options(AWSCloudInstance('ami-1', 'us-west-1', 't2.micro', 30), context) == {
        'ami_image': 'ami-1', 'region': 'us-west-1', 'ec2_instance_type': 't2.micro',
        'disk_size': 30}
    assert options(KubeInstance('image', 'zone', 100, 200), context) == {
        'container_image': 'image', 'zone': 'zone', 'mcpu': 100, 'mb': 200}


IMAGES = {'us-west-1': 'ami-1', 'eu-west-1': 'ami-2'}


def test_a_value_may_depend_on_the_region(context):
    context.launch_configurations['image'] = 'ami-1'
    machine = AWSCloudInstance(region='us-west-1', ami_image={
        'us-west-1': LaunchConfiguration('image'), 'eu-west-1': 'ami-2'})
    assert options(machine, context) == {'region': 'us-west-1', 'ami_image': IMAGES}
    assert machine.info()['aws_ami_image'] == 'ami-1'
    assert AWSCloudInstance(ami_image=IMAGES).info()['aws_ami_image'] == IMAGES


@pytest.mark.parametrize(('text', 'expected'), [
    ('ami-1', 'ami-1'), ('{us-west-1: ami-1, eu-west-1: ami-2}', IMAGES)])
def test_regional_values_in_text(text, expected):
    assert keywords.read(keywords.keywords(AWSCloudInstance)['ami_image'], text) == expected


def test_launch_arguments(context):
    context.launch_configurations.update(
        spot='true', no='False', cpu='4', price='0.25', tag='red', kind='t3.large')

    def value(name):
        return LaunchConfiguration(name)

    assert options(AWSCloudInstance(
        spot=value('spot'), min_cpu=value('cpu'), max_price=value('price'),
        tags={'team': value('tag')}, instance_types=['t3.small', value('kind')]), context) == {
            'spot': True, 'min_cpu': 4, 'max_price': 0.25, 'tags': {'team': 'red'},
            'instance_types': ['t3.small', 't3.large']}
    assert options(AWSCloudInstance(spot=value('no')), context) == {'spot': False}
    assert options(AWSCloudInstance(max_price=Decimal('0.3')), context) == {'max_price': 0.3}
    with pytest.raises(ConfigurationError, match="'red' is neither true nor false"):
        AWSCloudInstance(spot=value('tag')).spec(context)


@pytest.mark.parametrize(('make', 'message'), [
    (lambda: AWSCloudInstance(instance_type='t3.small'), "did you mean 'instance_types'"),
    (lambda: AWSCloudInstance(regon='x'), "did you mean 'region'"),
    (lambda: KubeInstance(image='x'), 'KubeInstance has no attribute'),
    (lambda: KubeInstance(on_interrupt='robots'), "did you mean 'robot'"),
])
def test_mistakes(make, message):
    with pytest.raises(ConfigurationError) as caught:
        make()
    assert message in str(caught.value)


def test_info_has_fogros2_s_keys(context):
    machine = AWSCloudInstance('ami-1', region='us-west-1', disk_size=40, name='cloud')
    told = machine.info()
    assert (told['aws_ami_image'], told['ec2_region'], told['disk_size']) == (
        'ami-1', 'us-west-1', 40)
    assert told['ec2_instance_id'] is None
    machine.spec(context)
    # once it is up, with what the provider chose
    machine.is_up(SimpleNamespace(
        spec=SimpleNamespace(
            provider='aws', options={'region': 'us-west-2', 'ec2_instance_type': 't3.nano'}),
        machine=SimpleNamespace(id='aws:us-west-2/i-0123', vpn_host='198.51.100.7', endpoint=None),
        vpn_address='198.18.0.2'))
    told = machine.info()
    assert (told['ec2_region'], told['ec2_instance_type']) == ('us-west-2', 't3.nano')
    assert told['ec2_instance_id'] == 'i-0123'
    cloud = fogros2.GCPCloudInstance(region='europe-west3', machine_type='e2-small')
    assert (cloud.info()['compute_region'], cloud.info()['compute_instance_type']) == (
        'europe-west3', 'e2-small')
    cloud.spec(context)
    cloud.is_up(SimpleNamespace(
        spec=SimpleNamespace(provider='gcp', options={'zone': 'europe-west3-a'}),
        machine=SimpleNamespace(
            id='gcp:robots/europe-west3-a/cloud-1/77', vpn_host='198.51.100.7', endpoint=None),
        vpn_address='198.18.0.2'))
    told = cloud.info()
    assert (told['compute_region'], told['compute_instance_id']) == ('europe-west3-a', 'cloud-1')
    pod = KubeInstance(mcpu=100, mb=200, zone='b').info()
    assert (pod['compute_region'], pod['compute_instance_type']) == ('b', '100mx200Mb')


# -- what is found out later ----------------------------------------------------------------------

@pytest.fixture
def asked(monkeypatch):
    """Record the provider's calls, and answer."""
    noted = []

    def nearest(self, names=()):
        noted.append(('nearest', tuple(names)))
        return 'eu-north-1'

    def offers(self, wanted, regions=(), *, refresh=False):
        noted.append(('offers', wanted, tuple(regions)))
        name = 't2.medium' if wanted.cores else 't4g.large'
        region = 'eu-west-3' if len(regions) != 1 or 'all' in regions else regions[0]
        kind = MachineType(name, 8, 4, 16.0, 'x86_64')
        return Offers(wanted, (Offer(region, kind, Decimal(1), Decimal(1)),), tuple(regions))

    monkeypatch.setattr(AWSProvider, 'nearest', nearest)
    monkeypatch.setattr(CloudSeller, 'offers', offers)
    return noted


def found(machine, context):
    """Return a machine's options as the launch asks for them, in a thread of its own."""
    return values.await_all(options(machine, context))


def test_nobody_is_asked_before_the_launch_does(asked, context):
    region = fogros2.find_nearest_aws_region()
    kind = fogros2.find_cheapest_ec2_instance_type(region, default_cores=4, gpu=True)
    machine = AWSCloudInstance(region=region, ec2_instance_type=kind)
    assert 'nearest' in repr(region) and 'nearest' in machine.info()['ec2_region']
    spec = machine.spec(context)
    assert asked == []
    assert values.await_all(spec.options) == {
        'region': 'eu-north-1', 'ec2_instance_type': 't2.medium'}
    assert asked == [('nearest', ()),
                     ('offers', wants(
                         arch='x86_64', min_cpu=0, min_memory_gb=0, gpu=True, cores=4,
                         threads_per_core=1), ('eu-north-1',))]
    # once, for all machines
    other = AWSCloudInstance(region=region, ec2_instance_type=kind)
    assert found(other, context) == values.await_all(spec.options)
    assert region.perform(context) == 'eu-north-1' and len(asked) == 2


def test_the_one_helper_that_asks_at_once(asked):
    assert fogros2.nearest_aws_region_now(list(IMAGES)) == 'eu-north-1'
    assert asked == [('nearest', tuple(IMAGES))]


def test_the_cheapest_of_all(asked, context):
    region, kind = fogros2.find_cheapest(['eu-west-3', 'eu-west-1'], spot=True)
    assert found(AWSCloudInstance(region=region, ec2_instance_type=kind), context) == {
        'region': 'eu-west-3', 'ec2_instance_type': 't4g.large'}
    assert asked == [('offers', wants(spot=True), ('eu-west-3', 'eu-west-1'))]
    with pytest.raises(ConfigurationError, match="takes no 'cores'"):
        fogros2.find_cheapest(cores=3)


def test_machine_of_any_cloud_is_described_without_a_request(context, monkeypatch):
    monkeypatch.setattr(CloudSeller, 'offers', lambda *_, **__: pytest.fail('a request'))
    wanted = {'min_cpu': 8, 'gpu': 'L4', 'max_round_trip_ms': 60, 'providers': ['aws', 'azure']}
    context.launch_configurations['cpus'] = '8'
    machine = fogros2.cheapest(
        **{**wanted, 'min_cpu': LaunchConfiguration('cpus')}, name='planner', ros_workspace='')
    spec = machine.spec(context)
    assert (spec.provider, spec.options, spec.wanted) == ('cheapest', wanted, None)
    assert machine.info()['cloud_service_provider'] == 'cheapest'
    said = 'planner=cheapest,min_cpu=8,gpu=L4,max_round_trip_ms=60,providers=[aws, azure]'
    assert overrides.parse(said).machine('planner').spec(context).options == wanted
    with pytest.raises(ConfigurationError, match="no attribute 'min_memory'") as caught:
        fogros2.cheapest(min_memory=4)
    assert 'min_memory_gb' in caught.value.hint


def test_fogros2_s_own_names(asked, context):
    from fogros2 import ec2_instance_type_selection, region_ami_selection
    region, image = region_ami_selection.find_nearest_region_and_ami({
        'us-east-1': {'ami_image': 'ami-1'}, 'eu-north-1': {'ami_image': 'ami-2'}})
    kind = ec2_instance_type_selection.find_cheapest_ec2_instance_type(region)
    assert found(AWSCloudInstance(
        region=region, ec2_instance_type=kind, ami_image=image), context) == {
            'region': 'eu-north-1', 'ec2_instance_type': 't2.medium', 'ami_image': 'ami-2'}
    assert asked == [
        ('nearest', ('us-east-1', 'eu-north-1')),
        ('offers', wants(arch='x86_64', min_cpu=0, min_memory_gb=0, cores=2, threads_per_core=1),
         ('eu-north-1',))]
    kind = fogros2.find_cheapest_ec2_instance_type(
        region_name='nearest', cpu_architecture='arm64', default_cores=4,
        default_threads_per_core=2, gpu=True)
    asked.clear()
    assert kind.perform(context) == 't2.medium'
    assert asked == [
        ('offers', wants(arch='arm64', min_cpu=0, min_memory_gb=0, gpu=True, cores=4,
                         threads_per_core=2), ('nearest',))]
