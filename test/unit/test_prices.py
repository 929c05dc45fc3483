# SPDX-License-Identifier: Apache-2.0
"""The cheapest type that fits, its cached prices, and how EC2's answers are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from decimal import Decimal
import json
from pathlib import Path
import stat
import threading
from types import SimpleNamespace
from typing import Any, Optional

from launch import LaunchContext
import pytest

from fogros2 import plugin_system
from fogros2.errors import ConfigurationError, PrerequisiteError, ProviderError
from fogros2.model import MachineSpec
from fogros2.provider.aws import prices
from fogros2.provider.aws.cloud import Ec2
from fogros2.provider.aws.provider import AWSProvider
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import PRICES_AGE
from fogros2.provider.vm.options import VmOptions
from fogros2_features.prices import choices
from fogros2_features.prices.market import CloudSeller, Market, seller
from fogros2_features.prices.offers import Wants, wants
from rigs.ec2 import iam

REGION = 'eu-central-1'
NOW = 1_800_000_000.0


def kind(
    name: str, vcpus: int, memory: float, cpu: str = 'Intel', *gpu: Any, arch: str = 'x86_64',
    cores: int = 0, spot: bool = True,
) -> MachineType:
    gpus, card, card_gb = gpu or (0, '', 0.0)
    return MachineType(
        name, vcpus, cores or vcpus // 2, memory, arch, cpu, gpus, card, card_gb, spot)


TYPES = [
    kind('t3.medium', 2, 4), kind('t3a.medium', 2, 4, 'AMD'),
    kind('t4g.medium', 2, 4, 'AWS', arch='arm64', cores=2),
    kind('m7a.large', 2, 8, 'AMD', cores=2), kind('t2.medium', 2, 4, cores=2),
    kind('c5.4xlarge', 16, 32), kind('m6i.2xlarge', 8, 32, spot=False),
    kind('g4dn.2xlarge', 8, 32, 'Intel', 1, 'NVIDIA T4', 16.0),
    kind('g6.2xlarge', 8, 32, 'AMD', 1, 'NVIDIA L4', 22.4),
    kind('g4ad.2xlarge', 8, 32, 'AMD', 1, 'AMD Radeon Pro V520', 8.0),
    kind('p4d.24xlarge', 96, 1152, 'Intel', 8, 'NVIDIA A100', 40.0)]
#: Compared as strings, '0.1072' would be below '0.0432' only by luck, and '10.5' below '9.4'.
PRICES = {
    't3.medium': '0.0480', 't3a.medium': '0.0432', 't4g.medium': '0.0384', 'm7a.large': '0.1380',
    't2.medium': '0.0536', 'c5.4xlarge': '0.7760', 'm6i.2xlarge': '0.4600',
    'g4dn.2xlarge': '10.5', 'g6.2xlarge': '9.4', 'g4ad.2xlarge': '0.6770', 'p4d.24xlarge': '40.1'}
SPOT = {'t3.medium': {'eu-central-1a': '0.0196', 'eu-central-1b': '0.0151'},
        't3a.medium': {'eu-central-1a': '0.0160'}, 'c5.4xlarge': {'eu-central-1b': '0.31'}}


class Source:
    """A cloud that counts the questions."""

    name, title, types_age = 'aws', 'AWS', PRICES_AGE

    def __init__(self) -> None:
        self.asked: list[tuple[str, str]] = []
        self.key = 'account'

    def account_key(self) -> str:
        return self.key

    def _ask(self, what: str, region: str) -> None:
        self.asked.append((what, region))
        if region == 'me-south-1':
            raise ProviderError('not enabled')

    def types(self, region: str) -> list[MachineType]:
        self._ask('types', region)
        return TYPES

    def zones(self, region: str) -> dict[str, list[str]]:
        self._ask('zones', region)
        return {one.name: [f'{region}a', *([f'{region}b'] if one.name != 'c5.4xlarge' else [])]
                for one in TYPES}

    def prices(self, region: str, name: str = '') -> dict[str, Decimal]:
        self._ask('prices', region)
        return {one: Decimal(price) for one, price in PRICES.items() if name in ('', one)}

    def spot_prices(self, region: str, names: Any) -> dict[str, dict[str, Decimal]]:
        self._ask('spot', region)
        return {one: {zone: Decimal(price) for zone, price in zones.items()}
                for one, zones in SPOT.items()}


@pytest.fixture
def source() -> Any:
    return Source()


@pytest.fixture
def market(source: Any, tmp_path: Path) -> Market:
    return Market(source, cache=tmp_path, clock=lambda: NOW)


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
    offers = market.choose([REGION], wants(arch='x86_64', gpu=1))
    assert [(o.type.name, str(o.price)) for o in offers.offers] == [
        ('g6.2xlarge', '9.4'), ('g4dn.2xlarge', '10.5'), ('p4d.24xlarge', '40.1')]
    assert offers.chosen.zones == ('eu-central-1a', 'eu-central-1b')
    offers = market.choose([REGION], wants(arch='x86_64', spot=True))
    assert [(o.type.name, str(o.spot_price), str(o.price)) for o in offers.offers] == [
        ('t3.medium', '0.0151', '0.0480'), ('t3a.medium', '0.0160', '0.0432')]


def test_a_price_cap(market: Market) -> None:
    offers = market.choose([REGION], wants(arch='x86_64', max_price='0.05'))
    assert [o.type.name for o in offers.offers] == ['t3a.medium', 't3.medium']
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


def test_region_without_an_answer_is_left_out(market: Market) -> None:
    offers = market.choose(['me-south-1', REGION, 'us-west-1'], wants(arch='x86_64'))
    assert offers.chosen.type.name == 't3a.medium'
    assert {offer.region for offer in offers.offers} == {REGION, 'us-west-1'}
    assert offers.left_out == (('me-south-1', 'not enabled'),)
    with pytest.raises(ProviderError, match='not enabled'):
        market.choose(['me-south-1'], Wants())


def test_price_of_one_type(source: Any, market: Market) -> None:
    assert market.price_of(REGION, 't3.medium') == Decimal('0.048')
    assert market.price_of(REGION, 't3.medium', spot=True) == Decimal('0.0151')
    assert source.asked == [('prices', REGION), ('spot', REGION)]
    with pytest.raises(ProviderError, match='no price of m9.huge in eu-central-1'):
        market.price_of(REGION, 'm9.huge')


def test_spot_machine_is_counted_with_its_dearest_zone(market: Market) -> None:
    for limit, price in ((None, '0.0196'), ('0.016', '0.0151'), ('0.01', '0.0151')):
        options = VmOptions(spot=True, max_price=limit and Decimal(limit))
        assert market.cost_of(REGION, 't3.medium', options) == Decimal(price)
    assert market.cost_of(REGION, 't3.medium', VmOptions()) == Decimal('0.048')
    # types are compared by their cheapest zone
    assert market.price_of(REGION, 't3.medium', spot=True) == Decimal('0.0151')


# -- the cache --------------------------------------------------------------------------------


def test_answers_are_cached_for_a_day(source: Any, tmp_path: Path) -> None:
    now = NOW

    def asks() -> int:
        source.asked.clear()
        Market(source, cache=tmp_path, clock=lambda: now).choose(
            [REGION], wants(arch='x86_64', spot=True))
        return len(source.asked)

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
    source.key = 'another endpoint'
    assert asks() == 4
    source.types_age = 300.0  # of a cloud that may leave a type out because it has none now
    now += 301
    assert asks() == 2


@pytest.mark.parametrize('damage', [
    lambda text: text[:len(text) // 2], lambda text: text.replace('0.0480', 'gratis'),
    lambda text: text.replace('t3.medium', 't3.\\ud800'), lambda text: '{"source": 1}',
    lambda text: text.replace('"vcpus"', '"threads"')])
def test_damaged_cache_is_requested_again(
    source: Any, tmp_path: Path, damage: Callable[[str], str],
) -> None:
    for _ in range(2):
        again = Market(source, cache=tmp_path, clock=lambda: NOW)
        assert again.prices(REGION)['t3a.medium'] == Decimal('0.0432')
        assert len(again.types(REGION)) == len(TYPES)
        for path in tmp_path.iterdir():
            path.write_text(damage(path.read_text()))


def test_a_folder_that_can_not_be_written_costs_time_alone(source: Any, tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    market = Market(source, cache=tmp_path / 'file' / 'below')
    assert market.prices(REGION)['t3.medium'] == Decimal('0.048')


def test_eight_machines_ask_once(source: Any, market: Market) -> None:
    threads = [threading.Thread(target=market.prices, args=(REGION,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(source.asked) == 1


# -- EC2 --------------------------------------------------------------------------------------


def product(name: str, price: str, unit: str = 'Hrs') -> str:
    """Return an entry of GetProducts' list."""
    return json.dumps({
        'product': {'sku': name, 'attributes': {'instanceType': name, 'regionCode': REGION}},
        'terms': {'OnDemand': {f'{name}.JRTCKXETXF': {'priceDimensions': {
            f'{name}.6YS6EN2CT7': {'unit': unit, 'pricePerUnit': {'USD': price}}}}}}})


def described(name: str, arch: str, **more: Any) -> dict[str, Any]:
    """Return an entry of DescribeInstanceTypes, as far as it matters here."""
    return {
        'InstanceType': name, 'SupportedUsageClasses': ['on-demand', 'spot'],
        'SupportedRootDeviceTypes': ['ebs'],
        'ProcessorInfo': {'SupportedArchitectures': [arch], 'Manufacturer': 'AMD'},
        'VCpuInfo': {'DefaultVCpus': 8, 'DefaultCores': 4},
        'MemoryInfo': {'SizeInMiB': 32768}, **more}


#: What EC2 answers, by operation.
ANSWERS: dict[str, list[Any]] = {
    'describe_instance_types': [described('mac2.metal', 'arm64_mac'), described(
        'g6.2xlarge', 'x86_64', GpuInfo={'Gpus': [{
            'Count': 1, 'Manufacturer': 'NVIDIA', 'Name': 'L4',
            'MemoryInfo': {'SizeInMiB': 22888}}]})],
    'describe_instance_type_offerings': [
        {'InstanceType': 't3.medium', 'Location': f'{REGION}{zone}'} for zone in 'ba'],
    # what else is sold under the name: nothing for reserved capacity, gigabytes
    'get_products': [product('t3.medium', '0.0480000000'), product('t3.medium', '0.0000000000'),
                     product('t3.medium', '0.01', 'GB')],
    # the second is older, and has been overtaken
    'describe_spot_price_history': [
        {'InstanceType': 't3.medium', 'AvailabilityZone': f'{REGION}a', 'SpotPrice': price}
        for price in ('0.0196', '0.0001')]}


def test_answers_of_ec2_are_read() -> None:
    asked: list[tuple[str, str]] = []

    def pages(
        service: str, region: str, operation: str, key: str, what: str, **words: Any,
    ) -> Iterator[Any]:
        asked.append((f'{service}:{operation}', region))
        yield from ANSWERS[operation]

    ec2 = Ec2(SimpleNamespace(pages=pages))  # type: ignore[arg-type]
    assert list(ec2.types(REGION)) == [kind('g6.2xlarge', 8, 32.0, 'AMD', 1, 'NVIDIA L4', 22.4)]
    assert ec2.zones(REGION) == {'t3.medium': ['eu-central-1a', 'eu-central-1b']}
    assert ec2.prices(REGION) == {'t3.medium': Decimal('0.048')}
    assert ec2.spot_prices(REGION, None) == {'t3.medium': {f'{REGION}a': Decimal('0.0196')}}
    # each pricing API has the prices of all regions: the nearest is asked
    ec2.prices('us-west-1')
    assert [region for what, region in asked if 'get_products' in what] == [REGION, 'us-east-1']
    assert {what.replace('_', '').lower() for what, _ in asked} == {
        action.lower() for action in (*iam.PRICES, 'ec2:DescribeInstanceTypes')}
    with pytest.raises(ProviderError, match='list of prices'):
        list(prices.on_demand_price('{"product": {}}'))


def test_prices_without_credentials_measure_no_region(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(own: Ec2) -> None:
        raise PrerequisiteError('there are no AWS credentials')

    monkeypatch.setattr(Ec2, 'check_credentials', refuse)
    monkeypatch.setattr(AWSProvider, 'nearest', lambda self: pytest.fail('took seconds'))
    with pytest.raises(PrerequisiteError):
        seller(AWSProvider()).offers(wants())


def test_type_is_not_chosen_without_the_feature(monkeypatch: pytest.MonkeyPatch) -> None:
    points = plugin_system._entry_points
    monkeypatch.setattr(plugin_system, '_entry_points', lambda group: (
        {} if group == 'fogros2.market' else points(group)))
    spec = MachineSpec('planner', 'aws', {'region': REGION, 'ec2_instance_type': 't3.medium'})
    assert AWSProvider().resolve(spec) == spec
    assert AWSProvider().cost_per_hour(spec) is None
    spec = MachineSpec('planner', 'aws', {'region': REGION, 'min_cpu': 8})
    with pytest.raises(ConfigurationError, match="there is no feature 'prices'"):
        AWSProvider().resolve(spec)


def test_price_limit_admits_the_price_itself(market: Market) -> None:
    for limit, spot in (('0.048', False), ('0.0151', True)):
        market.check(REGION, 't3.medium', VmOptions(spot=spot, max_price=Decimal(limit)))
    with pytest.raises(ConfigurationError, match='more than max_price=0.0479'):
        market.check(REGION, 't3.medium', VmOptions(max_price=Decimal('0.0479')))
