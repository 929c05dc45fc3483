# SPDX-License-Identifier: Apache-2.0
"""The cheapest type that fits, from answers of the shape that AWS gives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import datetime
from decimal import Decimal
import json
import os
from pathlib import Path
import stat
import threading
from typing import Any, Optional

import boto3
from botocore.stub import ANY, Stubber
from launch import LaunchContext
import pytest

from fogros2 import plugin_system
from fogros2.errors import ConfigurationError, FogError, PrerequisiteError, ProviderError
from fogros2.model import MachineSpec
from fogros2.provider.aws import prices
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.cloud import Ec2
from fogros2.provider.aws.provider import AWSProvider
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import PRICES_AGE
from fogros2_features.prices import choices
from fogros2_features.prices.market import CloudSeller, Market, seller
from fogros2_features.prices.offers import Wants, wants
from rigs.ec2 import iam

pytestmark = pytest.mark.usefixtures('boto_models')

REGION = 'eu-central-1'
NOW = 1_800_000_000.0


def entry(name: str, vcpus: int, memory: float, *, arch: str = 'x86_64', cores: int = 0,
          cpu: str = 'Intel', gpu: Optional[tuple[int, str, str, int]] = None,
          spot: bool = True) -> dict[str, Any]:
    """Return what DescribeInstanceTypes says of a type, as far as it matters here."""
    said: dict[str, Any] = {
        'InstanceType': name, 'CurrentGeneration': True, 'BareMetal': False,
        'SupportedUsageClasses': ['on-demand', *(['spot'] if spot else [])],
        'SupportedRootDeviceTypes': ['ebs'],
        'ProcessorInfo': {'SupportedArchitectures': [arch], 'Manufacturer': cpu},
        'VCpuInfo': {'DefaultVCpus': vcpus, 'DefaultCores': cores or vcpus // 2 or 1},
        'MemoryInfo': {'SizeInMiB': int(memory * 1024)}}
    if gpu is not None:
        count, maker, model, mib = gpu
        said['GpuInfo'] = {'Gpus': [{'Count': count, 'Manufacturer': maker, 'Name': model,
                                     'MemoryInfo': {'SizeInMiB': mib}}]}
    return said


TYPES = [
    entry('t3.medium', 2, 4), entry('t3a.medium', 2, 4, cpu='AMD'),
    entry('t4g.medium', 2, 4, arch='arm64', cores=2, cpu='AWS'),
    entry('m7a.large', 2, 8, cores=2, cpu='AMD'), entry('t2.medium', 2, 4, cores=2),
    entry('c5.4xlarge', 16, 32), entry('m6i.2xlarge', 8, 32, spot=False),
    entry('g4dn.2xlarge', 8, 32, gpu=(1, 'NVIDIA', 'T4', 16384)),
    entry('g6.2xlarge', 8, 32, cpu='AMD', gpu=(1, 'NVIDIA', 'L4', 22888)),
    entry('g4ad.2xlarge', 8, 32, cpu='AMD', gpu=(1, 'AMD', 'Radeon Pro V520', 8192)),
    entry('p4d.24xlarge', 96, 1152, gpu=(8, 'NVIDIA', 'A100', 40960)),
    entry('mac2.metal', 8, 16, arch='arm64_mac'),
]
#: Compared as strings, '0.1072' would be below '0.0432' only by luck, and '10.5' below '9.4'.
PRICES = {
    't3.medium': '0.0480000000', 't3a.medium': '0.0432000000', 't4g.medium': '0.0384000000',
    'm7a.large': '0.1380000000', 't2.medium': '0.0536000000', 'c5.4xlarge': '0.7760000000',
    'm6i.2xlarge': '0.4600000000', 'g4dn.2xlarge': '10.5000000000', 'g6.2xlarge': '9.4000000000',
    'g4ad.2xlarge': '0.6770000000', 'p4d.24xlarge': '40.1000000000',
    'mac2.metal': '0.6500000000'}
SPOT = [('t3.medium', 'eu-central-1a', '0.0196'), ('t3.medium', 'eu-central-1b', '0.0151'),
        ('t3a.medium', 'eu-central-1a', '0.0160'), ('c5.4xlarge', 'eu-central-1b', '0.31')]


def product(name: str, price: str, unit: str = 'Hrs') -> str:
    """Return an entry of GetProducts' list."""
    return json.dumps({
        'product': {'sku': name, 'attributes': {'instanceType': name, 'regionCode': REGION}},
        'terms': {'OnDemand': {f'{name}.JRTCKXETXF': {'priceDimensions': {
            f'{name}.6YS6EN2CT7': {'unit': unit, 'pricePerUnit': {'USD': price}}}}}},
        'serviceCode': 'AmazonEC2'})


class Recorded(Account):
    """An account with clients that answer one operation each, in pages, and check requests."""

    def __init__(self) -> None:
        super().__init__(boto3.Session())
        self.asked: list[tuple[str, str]] = []
        self.error = ''
        self.types: list[dict[str, Any]] = TYPES
        self.prices = PRICES
        self.spot = SPOT
        self._lock = threading.RLock()

    def client(self, service: str, region: str, *, hasty: bool = False) -> Any:
        client = boto3.client(service, region_name=region, aws_access_key_id='testing',
                              aws_secret_access_key='testing')
        recorded = self

        class Choosing:
            """Stubs the operation that is asked for."""

            def get_paginator(self, operation: str) -> Any:
                with recorded._lock:
                    recorded.asked.append((region, operation))
                stub = Stubber(client)
                if recorded.error:
                    stub.add_client_error(operation, recorded.error, 'no', 403)
                for answer, expected in recorded.answers(operation, region):
                    stub.add_response(operation, answer, expected)
                stub.activate()
                return client.get_paginator(operation)

        return Choosing()

    def answers(self, operation: str, region: str) -> Iterator[tuple[Any, Any]]:
        if operation == 'describe_instance_types':
            filters = {'Filters': [{'Name': 'current-generation', 'Values': ['true']},
                                   {'Name': 'bare-metal', 'Values': ['false']}]}
            yield {'InstanceTypes': self.types[:5], 'NextToken': 'n'}, filters
            yield {'InstanceTypes': self.types[5:]}, {**filters, 'NextToken': 'n'}
        elif operation == 'describe_instance_type_offerings':
            names = [kind['InstanceType'] for kind in self.types] + ['t2.nano']
            yield {'InstanceTypeOfferings': [
                {'InstanceType': name, 'LocationType': 'availability-zone',
                 'Location': f'{region}{zone}'} for name in names for zone in 'ba'
                if name != 'c5.4xlarge' or zone == 'a']}, {'LocationType': 'availability-zone'}
        elif operation == 'get_products':
            listed = [product(name, price) for name, price in self.prices.items()]
            # what else is sold under the name: nothing for reserved capacity, gigabytes
            listed += [product('t3.medium', '0.0000000000'), product('t3.medium', '0.01', 'GB')]
            yield {'PriceList': listed[:4], 'NextToken': 'n'}, ANY_ARGUMENTS
            yield {'PriceList': listed[4:]}, None
        else:
            when = datetime.datetime.fromtimestamp(NOW, datetime.timezone.utc)
            history = [{'InstanceType': name, 'AvailabilityZone': zone, 'SpotPrice': price,
                        'ProductDescription': 'Linux/UNIX', 'Timestamp': when}
                       for name, zone, price in self.spot]
            # an older one in the same zone, which has been overtaken
            history.append({**history[0], 'SpotPrice': '0.0001',
                            'Timestamp': when - datetime.timedelta(hours=1)})
            yield {'SpotPriceHistory': history}, None


ANY_ARGUMENTS = {'ServiceCode': 'AmazonEC2', 'FormatVersion': 'aws_v1', 'Filters': ANY}


@pytest.fixture
def recorded() -> Recorded:
    return Recorded()


@pytest.fixture
def market(recorded: Recorded, tmp_path: Path) -> Market:
    return Market(Ec2(recorded), cache=tmp_path, clock=lambda: NOW)


@pytest.mark.parametrize(('asked', 'name'), [
    ({}, 't3a.medium'),
    ({'arch': 'any'}, 't4g.medium'),
    ({'arch': 'aarch64'}, 't4g.medium'),
    ({'cpu_type': 'intel'}, 't3.medium'),
    ({'min_cpu': 8, 'min_memory_gb': 32}, 'm6i.2xlarge'),
    ({'min_cpu': 8, 'min_memory_gb': 32, 'gpu': 1}, 'g6.2xlarge'),
    ({'gpu': True, 'gpu_memory_gb': 24}, 'g6.2xlarge'),
    ({'gpu': 'T4'}, 'g4dn.2xlarge'),
    ({'gpu': 'a100', 'gpu_memory_gb': 40}, 'p4d.24xlarge'),
    ({'gpu': 'amd'}, 'g4ad.2xlarge'),
    ({'gpu': 2}, 'p4d.24xlarge'),
    ({'spot': True}, 't3.medium'),
    ({'spot': True, 'min_cpu': 8, 'min_memory_gb': 16}, None),
])
def test_cheapest_fitting_type_is_chosen(
    market: Market, asked: dict[str, Any], name: Optional[str],
) -> None:
    given = {'arch': 'x86_64', **asked}
    if name is None:
        # its only spot price is for a zone that doesn't offer it
        with pytest.raises(ConfigurationError, match='no AWS type in eu-central-1 has 8 CPUs'):
            market.choose([REGION], wants(**given))
    else:
        assert market.choose([REGION], wants(**given)).chosen.type.name == name


def test_prices_are_compared_as_numbers(market: Market) -> None:
    found = market.choose([REGION], wants(arch='x86_64', gpu=1))
    assert [(o.type.name, o.price) for o in found.offers] == [
        ('g6.2xlarge', Decimal('9.4000000000')), ('g4dn.2xlarge', Decimal('10.5000000000')),
        ('p4d.24xlarge', Decimal('40.1000000000'))]
    assert found.chosen.zones == ('eu-central-1a', 'eu-central-1b')


def test_spot_takes_the_newest_price_of_the_cheapest_zone(market: Market) -> None:
    found = market.choose([REGION], wants(arch='x86_64', spot=True))
    assert [(o.type.name, o.spot_price, o.price) for o in found.offers] == [
        ('t3.medium', Decimal('0.0151'), Decimal('0.0480000000')),
        ('t3a.medium', Decimal('0.0160'), Decimal('0.0432000000'))]


def test_a_price_cap(market: Market) -> None:
    asked = wants(arch='x86_64', max_price='0.05')
    found = market.choose([REGION], asked)
    assert [o.type.name for o in found.offers] == ['t3a.medium', 't3.medium']
    with pytest.raises(ConfigurationError, match=r'at most \$0.01 .*t3a.medium.*\$0.0432'):
        market.choose([REGION], wants(arch='x86_64', max_price=0.01))


@pytest.mark.parametrize('asked', [
    {'max_price': 'cheap'}, {'max_price': -1}, {'max_price': 'nan'}, {'arch': 'mips'},
    {'min_cpu': -1}, {'gpu': -1}, {'min_memory_gb': float('nan')}])
def test_what_makes_no_sense_is_refused(asked: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError):
        wants(**asked)


def test_the_architecture_is_this_computer_s(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('platform.machine', lambda: 'aarch64')
    assert wants().arch == 'arm64'
    assert wants(arch='x86_64').arch == 'x86_64'


def test_as_fogros2_asks(market: Market, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CloudSeller, 'offers', lambda self, wanted, regions, refresh:
                        market.choose(regions, wanted))
    context = LaunchContext()
    find = choices.find_cheapest_ec2_instance_type
    assert find(REGION).perform(context) == 't2.medium'
    assert find(REGION, cpu_architecture='arm64', default_cores=2, default_threads_per_core=1,
                gpu=False).perform(context) == 't4g.medium'
    assert find(REGION, default_cores=4, default_threads_per_core=2,
                gpu=True).perform(context) == 'g6.2xlarge'


def test_several_regions(recorded: Recorded, market: Market) -> None:
    found = market.choose([REGION, 'us-west-1'], wants(arch='x86_64'))
    assert {offer.region for offer in found.offers} == {REGION, 'us-west-1'}
    assert found.chosen.type.name == 't3a.medium'
    # each pricing API has the prices of all regions: the nearest is asked
    assert {region for region, what in recorded.asked if what == 'get_products'} == {
        'eu-central-1', 'us-east-1'}


def test_region_without_an_answer_is_left_out(
    recorded: Recorded, market: Market, monkeypatch: pytest.MonkeyPatch,
) -> None:
    ask = market.zones

    def zones(region: str) -> dict[str, list[str]]:
        if region == 'me-south-1':
            raise ProviderError('not enabled')
        return ask(region)

    monkeypatch.setattr(market, 'zones', zones)
    found = market.choose(['me-south-1', REGION], wants(arch='x86_64'))
    assert found.chosen.region == REGION and found.left_out == (('me-south-1', 'not enabled'),)
    with pytest.raises(ProviderError, match='not enabled'):
        market.choose(['me-south-1'], Wants())


def test_price_of_one_type(recorded: Recorded, market: Market) -> None:
    recorded.prices = {'t3.medium': '0.0480000000'}
    assert market.price_of(REGION, 't3.medium') == Decimal('0.048')
    assert market.price_of(REGION, 't3.medium', spot=True) == Decimal('0.0151')
    assert [what for _, what in recorded.asked] == ['get_products', 'describe_spot_price_history']
    with pytest.raises(ProviderError, match='no price of m9.huge in eu-central-1'):
        market.price_of(REGION, 'm9.huge')


def test_answers_of_aws_are_cached_for_a_day(recorded: Recorded, tmp_path: Path) -> None:
    now = NOW

    def asks() -> int:
        recorded.asked.clear()
        Market(Ec2(recorded), cache=tmp_path, clock=lambda: now).choose(
            [REGION], wants(arch='x86_64', spot=True))
        return len(recorded.asked)

    assert asks() == 4
    assert asks() == 0
    for path in tmp_path.iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o600 and path.suffix == '.json'
    now += PRICES_AGE - 1
    assert asks() == 0
    now += 2
    assert asks() == 4
    now -= 3600  # a clock that was set back: what comes from the future isn't trusted
    assert asks() == 4


def test_another_endpoint_is_not_believed(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    Market(Ec2(recorded), cache=tmp_path).prices(REGION)
    monkeypatch.setenv('AWS_ENDPOINT_URL', 'http://127.0.0.1:9')
    Market(Ec2(recorded), cache=tmp_path).prices(REGION)
    assert len(recorded.asked) == 2


@pytest.mark.parametrize('damage', [
    lambda text: text[:len(text) // 2], lambda text: text.replace('0.0480000000', 'gratis'),
    lambda text: text.replace('t3.medium', 't3.\\ud800'), lambda text: '{"source": 1}'])
def test_damaged_cache_is_requested_again(
    recorded: Recorded, tmp_path: Path, damage: Callable[[str], str],
) -> None:
    Market(Ec2(recorded), cache=tmp_path, clock=lambda: NOW).prices(REGION)
    path = tmp_path / f'prices-{REGION}.json'
    path.write_text(damage(path.read_text()))
    found = Market(Ec2(recorded), cache=tmp_path, clock=lambda: NOW).prices(REGION)
    assert found['t3a.medium'] == Decimal('0.0432')


def test_cache_of_another_version_is_not_used(
    recorded: Recorded, tmp_path: Path,
) -> None:
    Market(Ec2(recorded), cache=tmp_path, clock=lambda: NOW).types(REGION)
    path = tmp_path / f'types-{REGION}.json'
    path.write_text(path.read_text().replace('"vcpus"', '"threads"'))
    assert len(Market(Ec2(recorded), cache=tmp_path, clock=lambda: NOW).types(REGION)) == 11


def test_a_folder_that_can_not_be_written_costs_time_alone(
    recorded: Recorded, tmp_path: Path,
) -> None:
    (tmp_path / 'file').write_text('')
    market = Market(Ec2(recorded), cache=tmp_path / 'file' / 'below')
    assert market.prices(REGION)['t3.medium'] == Decimal('0.048')


def test_eight_machines_ask_once(recorded: Recorded, market: Market) -> None:
    threads = [threading.Thread(target=market.prices, args=(REGION,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(recorded.asked) == 1


def test_a_refusal_is_a_fog_error(recorded: Recorded, market: Market) -> None:
    recorded.error = 'UnauthorizedOperation'
    with pytest.raises(FogError, match='policy .* does not allow ec2:DescribeInstanceTypes'):
        market.types(REGION)


def test_the_policy_allows_what_is_asked(recorded: Recorded, market: Market) -> None:
    market.choose([REGION], wants(arch='x86_64'), spot_too=True)
    asked = {f"{'pricing' if what == 'get_products' else 'ec2'}:{xform_back(what)}"
             for _, what in recorded.asked}
    assert len(asked) == 4 and asked <= set(iam.ACTIONS)


def xform_back(operation: str) -> str:
    return ''.join(word.capitalize() for word in operation.split('_'))


def test_a_list_of_prices_that_can_not_be_read() -> None:
    with pytest.raises(ProviderError, match='list of prices'):
        list(prices.on_demand_price('{"product": {}}'))


def test_types_are_read() -> None:
    kinds = [prices.instance_type(kind) for kind in TYPES]
    assert kinds[-1] is None
    assert kinds[8] == MachineType('g6.2xlarge', 8, 4, 32.0, 'x86_64', 'AMD', 1, 'NVIDIA L4',
                                    22.4, True)


def test_prices_without_credentials_measure_no_region(monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(*_: Any) -> str:
        raise AssertionError('took seconds, for nothing')

    for name in list(os.environ):
        if name.startswith('AWS_'):
            monkeypatch.delenv(name)
    for name in ('AWS_CONFIG_FILE', 'AWS_SHARED_CREDENTIALS_FILE'):
        monkeypatch.setenv(name, os.devnull)
    monkeypatch.setenv('AWS_EC2_METADATA_DISABLED', 'true')
    monkeypatch.setattr(AWSProvider, 'nearest', measured)
    with pytest.raises(PrerequisiteError, match='there are no AWS credentials'):
        seller(AWSProvider()).offers(wants())


def test_type_is_not_chosen_without_the_feature(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = plugin_system._entry_points
    monkeypatch.setattr(plugin_system, '_entry_points', lambda group: (
        {} if group == 'fogros2.market' else points(group)))
    spec = MachineSpec('planner', 'aws', {'region': REGION, 'ec2_instance_type': 't3.medium'})
    assert AWSProvider(Ec2(recorded)).resolve(spec) == spec
    assert AWSProvider(Ec2(recorded)).cost_per_hour(spec) is None
    spec = MachineSpec('planner', 'aws', {'region': REGION, 'min_cpu': 8})
    with pytest.raises(ConfigurationError, match="there is no feature 'prices'"):
        AWSProvider(Ec2(recorded)).resolve(spec)


def test_an_unknown_region_of_aws_is_named() -> None:
    with pytest.raises(ConfigurationError, match='AWS has no region mars-1'):
        AWSProvider().regions(['mars-1'])
