# SPDX-License-Identifier: Apache-2.0
"""What AWS offers and what it asks for it: types, zones, prices; kept on disk for a day."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
from decimal import Decimal, InvalidOperation
import hashlib
import json
import os
from pathlib import Path
import threading
import time
from typing import Any, Optional

from fogros2.errors import ProviderError, StoreError
from fogros2.provider.aws import patience
from fogros2.provider.aws.clients import usual
from fogros2.provider.aws.failures import translated
from fogros2.provider.aws.regions import distance_km, REGIONS
from fogros2.store import state_home, write_private

#: Returns a boto3 client for a service and a region.
Clients = Callable[[str, str], Any]

#: Seconds for which what AWS has said is taken as it is.
CACHE_AGE = 86400.0
#: The regions in which the pricing API lives.
PRICING_REGIONS = ('us-east-1', 'eu-central-1', 'ap-south-1')
#: What AWS sells under the name of an instance type, narrowed down to the plain Linux machine.
ON_DEMAND = {
    'operatingSystem': 'Linux', 'tenancy': 'Shared', 'preInstalledSw': 'NA',
    'capacitystatus': 'Used', 'marketoption': 'OnDemand',
}
SPOT_PRODUCT = 'Linux/UNIX'
#: What an operation is, for messages.
_WORDS = {
    'describe_instance_types': 'asking for the instance types',
    'describe_instance_type_offerings': 'asking for the zones of the instance types',
    'describe_spot_price_history': 'asking for the spot prices',
    'get_products': 'asking for the prices',
}
#: The most types that one request for spot prices may name.
_NAMED_TYPES = 100


@dataclasses.dataclass(frozen=True)
class InstanceType:
    """
    A kind of machine.

    :param vcpus: hardware threads, ``cores`` physical ones.
    :param memory_gb: GiB of memory.
    :param arch: ``x86_64`` or ``arm64``; others are left out.
    :param cpu: who made the processor: Intel, AMD, AWS.
    :param gpus: how many, ``gpu_memory_gb`` GiB each.
    :param gpu: maker and name, such as 'NVIDIA T4'.
    :param spot: whether it can be had as a spot instance.
    """

    name: str
    vcpus: int
    cores: int
    memory_gb: float
    arch: str
    cpu: str = ''
    gpus: int = 0
    gpu: str = ''
    gpu_memory_gb: float = 0.0
    spot: bool = False


class Market:
    """
    What there is in each region, and what it costs; thread-safe.

    :param clients: makes the boto3 clients; None for those of the usual account.
    :param cache: folder of what AWS said before, None for the one below the state folder.
    :param clock: seconds since the epoch.
    :param refresh: ask anew, whatever the cache has.
    :param cancel: nobody waits for an answer any more once it is set.
    """

    def __init__(
        self, clients: Optional[Clients] = None, *, cache: Optional[Path] = None,
        clock: Callable[[], float] = time.time, refresh: bool = False,
        cancel: Optional[threading.Event] = None,
    ) -> None:
        self._clients = clients or usual().client
        self._cache = cache
        self._clock = clock
        self._refresh = refresh
        self._cancel = cancel
        self._known: dict[str, Any] = {}
        self._locks: dict[str, threading.Lock] = {}
        self._lock = threading.Lock()

    def types(self, region: str) -> list[InstanceType]:
        """
        Return the types of the current generation that a region has.

        :raises FogError: AWS refused, or can't be reached.
        """
        found = self._kept(f'types-{region}', lambda: [
            dataclasses.asdict(kind) for kind in self._ask_types(region)])
        return [InstanceType(**kind) for kind in found]

    def zones(self, region: str) -> dict[str, list[str]]:
        """Return the zones in which a region has each type."""
        return dict(self._kept(f'zones-{region}', lambda: self._ask_zones(region)))

    def prices(self, region: str) -> dict[str, Decimal]:
        """Return what each type costs by the hour (US dollars)."""
        found = self._kept(f'prices-{region}', lambda: _plain(self._ask_prices(region)))
        return {name: Decimal(price) for name, price in found.items()}

    def price(self, region: str, name: str) -> Optional[Decimal]:
        """
        Return what one type costs by the hour (US dollars), None where it isn't sold.

        One request, where the whole list isn't known yet.
        """
        listed = self._fresh(f'prices-{region}')
        if listed is None:
            listed = self._kept(f'price-{region}-{name}',
                                lambda: _plain(self._ask_prices(region, name)))
        return Decimal(listed[name]) if name in listed else None

    def spot(
        self, region: str, names: Optional[Sequence[str]] = None,
    ) -> dict[str, dict[str, Decimal]]:
        """
        Return what each type costs as a spot instance now, by zone (US dollars an hour).

        :param names: the types that matter; None for all.
        """
        named = sorted(names) if names is not None and len(names) <= _NAMED_TYPES else None
        key = f'spot-{region}'
        if named is not None and self._fresh(key) is None:
            key += '-' + hashlib.sha256(' '.join(named).encode()).hexdigest()[:12]
        found = self._kept(key, lambda: {
            name: _plain(zones) for name, zones in self._ask_spot(region, named).items()})
        return {name: {zone: Decimal(price) for zone, price in zones.items()}
                for name, zones in found.items() if names is None or name in names}

    # -- what is asked --------------------------------------------------------------------

    def _ask_types(self, region: str) -> Iterator[InstanceType]:
        for page in self._pages('ec2', region, 'describe_instance_types', Filters=[
                {'Name': 'current-generation', 'Values': ['true']},
                {'Name': 'bare-metal', 'Values': ['false']}]):
            for entry in page['InstanceTypes']:
                kind = instance_type(entry)
                if kind is not None:
                    yield kind

    def _ask_zones(self, region: str) -> dict[str, list[str]]:
        zones: dict[str, list[str]] = {}
        for page in self._pages('ec2', region, 'describe_instance_type_offerings',
                                LocationType='availability-zone'):
            for entry in page['InstanceTypeOfferings']:
                zones.setdefault(entry['InstanceType'], []).append(entry['Location'])
        return {name: sorted(places) for name, places in zones.items()}

    def _ask_prices(self, region: str, name: str = '') -> dict[str, Decimal]:
        wanted = {**ON_DEMAND, 'regionCode': region, **({'instanceType': name} if name else {})}
        filters = [{'Type': 'TERM_MATCH', 'Field': field, 'Value': value}
                   for field, value in wanted.items()]
        prices: dict[str, Decimal] = {}
        for page in self._pages('pricing', pricing_region(region), 'get_products',
                                ServiceCode='AmazonEC2', FormatVersion='aws_v1', Filters=filters):
            for text in page['PriceList']:
                for kind, price in on_demand_price(text):
                    prices[kind] = min(price, prices.get(kind, price))
        return prices

    def _ask_spot(
        self, region: str, names: Optional[Sequence[str]],
    ) -> dict[str, dict[str, Decimal]]:
        prices: dict[str, dict[str, Decimal]] = {}
        newest: dict[tuple[str, str], float] = {}
        # from now on: what AWS answers is the price that holds now
        arguments: dict[str, Any] = {
            'StartTime': self._clock(), 'ProductDescriptions': [SPOT_PRODUCT]}
        if names is not None:
            arguments['InstanceTypes'] = list(names)
        for page in self._pages('ec2', region, 'describe_spot_price_history', **arguments):
            for entry in page['SpotPriceHistory']:
                name, zone = entry['InstanceType'], entry['AvailabilityZone']
                when = entry['Timestamp'].timestamp()
                if when >= newest.get((name, zone), when):
                    newest[name, zone] = when
                    prices.setdefault(name, {})[zone] = Decimal(entry['SpotPrice'])
        return prices

    def _pages(self, service: str, region: str, operation: str, **arguments: Any) -> list[Any]:
        def ask() -> list[Any]:
            with translated(_WORDS[operation], region):
                api = self._clients(service, region)
                return list(api.get_paginator(operation).paginate(**arguments))

        return patience.unless(self._cancel, ask, _WORDS[operation])

    # -- what is kept ---------------------------------------------------------------------

    def _kept(self, key: str, ask: Callable[[], Any]) -> Any:
        """Return what is known under a key, asking at most once at a time."""
        with self._lock:
            lock = self._locks.setdefault(key, threading.Lock())
        with lock:
            found = self._fresh(key)
            if found is None:
                found = self._known[key] = ask()
                self._keep(key, found)
            return found

    def _fresh(self, key: str) -> Any:
        """Return what was said less than a day ago, None where nothing was."""
        if key in self._known:
            return self._known[key]
        if self._refresh:
            return None
        try:
            data = json.loads(self._path(key).read_text())
            if data['source'] != source() \
                    or not 0 <= self._clock() - float(data['time']) < CACHE_AGE:
                return None
            found = _checked(key, data['value'])
        except (OSError, ValueError, KeyError, TypeError, AttributeError, InvalidOperation):
            return None  # none yet, or damaged: it is asked for anew
        self._known[key] = found
        return found

    def _keep(self, key: str, value: Any) -> None:
        with contextlib.suppress(StoreError):  # a full disk costs time, not the launch
            write_private(self._path(key), json.dumps({
                'source': source(), 'time': self._clock(), 'value': value}).encode())

    def _path(self, key: str) -> Path:
        return (self._cache or state_home() / 'cache' / 'aws') / f'{key}.json'


def source() -> str:
    """Return whose word the cache holds: another endpoint's or account's is not this one's."""
    return '|'.join(os.environ.get(name, '') for name in (
        'AWS_ENDPOINT_URL', 'AWS_ENDPOINT_URL_EC2', 'AWS_ENDPOINT_URL_PRICING', 'AWS_PROFILE'))


def pricing_region(region: str) -> str:
    """Return which region's pricing API is the nearest to a region."""
    if region not in REGIONS:
        return PRICING_REGIONS[0]
    here = REGIONS[region][:2]
    return min(PRICING_REGIONS, key=lambda name: distance_km(here, REGIONS[name][:2]))


def instance_type(entry: Mapping[str, Any]) -> Optional[InstanceType]:
    """Return an entry of DescribeInstanceTypes, None for a kind that runs no Linux of ours."""
    architectures = entry['ProcessorInfo'].get('SupportedArchitectures', [])
    arch = next((name for name in ('x86_64', 'arm64') if name in architectures), None)
    if arch is None or 'ebs' not in entry.get('SupportedRootDeviceTypes', ['ebs']):
        return None
    threads, gpus = entry['VCpuInfo'], entry.get('GpuInfo', {}).get('Gpus', [])
    return InstanceType(
        entry['InstanceType'], int(threads['DefaultVCpus']),
        int(threads.get('DefaultCores', threads['DefaultVCpus'])),
        entry['MemoryInfo']['SizeInMiB'] / 1024, arch,
        entry['ProcessorInfo'].get('Manufacturer', ''),
        sum(int(gpu.get('Count', 1)) for gpu in gpus),
        f"{gpus[0].get('Manufacturer', '')} {gpus[0].get('Name', '')}".strip() if gpus else '',
        round(gpus[0].get('MemoryInfo', {}).get('SizeInMiB', 0) / 1024, 1) if gpus else 0.0,
        'spot' in entry.get('SupportedUsageClasses', []))


def on_demand_price(text: str) -> Iterator[tuple[str, Decimal]]:
    """
    Yield the type and the price by the hour (US dollars) of an entry of GetProducts' list.

    :raises ProviderError: it isn't the JSON that it should be.
    """
    try:
        product = json.loads(text)
        name = product['product']['attributes']['instanceType']
        for term in product.get('terms', {}).get('OnDemand', {}).values():
            for dimension in term['priceDimensions'].values():
                price = Decimal(dimension['pricePerUnit'].get('USD', '0'))
                if dimension['unit'] == 'Hrs' and price > 0:
                    yield name, price
    except (ValueError, KeyError, TypeError, AttributeError, InvalidOperation) as error:
        raise ProviderError(f"AWS's list of prices can't be read: {error!r}") from error


def _checked(key: str, value: Any) -> Any:
    """Return a cached value, an error if it isn't what is kept under such a key."""
    kind = key.partition('-')[0]
    if kind == 'types':
        return [dataclasses.asdict(InstanceType(**entry)) for entry in value]
    for entry in value.values():
        if kind == 'zones':
            if not all(isinstance(zone, str) for zone in entry):
                raise TypeError(key)
        else:
            for price in entry.values() if kind == 'spot' else (entry,):
                Decimal(price)
    return value


def _plain(prices: Mapping[str, Decimal]) -> dict[str, str]:
    return {name: str(price) for name, price in prices.items()}


def cheapest_zone(zones: Mapping[str, Decimal], among: Iterable[str]) -> Optional[Decimal]:
    """Return the lowest of the prices in some zones, None where there is none."""
    return min((zones[zone] for zone in among if zone in zones), default=None)
