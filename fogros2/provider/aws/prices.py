# SPDX-License-Identifier: Apache-2.0
"""Types, zones and prices of EC2, as AWS's API reports them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal, InvalidOperation
import json
import os
import time
from typing import Any, Optional

from fogros2.errors import ProviderError
from fogros2.provider.aws.clients import Account
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import VmCloud

#: The regions that have a pricing API.
PRICING_REGIONS = ('us-east-1', 'eu-central-1', 'ap-south-1')
#: Filters of the price list for the plain Linux machine.
ON_DEMAND = {
    'operatingSystem': 'Linux', 'tenancy': 'Shared', 'preInstalledSw': 'NA',
    'capacitystatus': 'Used', 'marketoption': 'OnDemand',
}
SPOT_PRODUCT = 'Linux/UNIX'


class Ec2Prices(VmCloud):
    """The part of EC2 that has types and prices."""

    _account: Account

    def account_key(self) -> str:
        return '|'.join(os.environ.get(name, '') for name in (
            'AWS_ENDPOINT_URL', 'AWS_ENDPOINT_URL_EC2', 'AWS_ENDPOINT_URL_PRICING', 'AWS_PROFILE'))

    def types(self, region: str) -> Iterator[MachineType]:
        for entry in self._account.pages(
                'ec2', region, 'describe_instance_types', 'InstanceTypes',
                'asking for the instance types', Filters=[
                    {'Name': 'current-generation', 'Values': ['true']},
                    {'Name': 'bare-metal', 'Values': ['false']}]):
            kind = instance_type(entry)
            if kind is not None:
                yield kind

    def zones(self, region: str) -> dict[str, list[str]]:
        zones: dict[str, list[str]] = {}
        for entry in self._account.pages(
                'ec2', region, 'describe_instance_type_offerings', 'InstanceTypeOfferings',
                'asking for the zones of the instance types', LocationType='availability-zone'):
            zones.setdefault(entry['InstanceType'], []).append(entry['Location'])
        return {name: sorted(places) for name, places in zones.items()}

    def prices(self, region: str, name: str = '') -> dict[str, Decimal]:
        wanted = {**ON_DEMAND, 'regionCode': region, **({'instanceType': name} if name else {})}
        prices: dict[str, Decimal] = {}
        place = self.regions.table.get(region)
        near = self.regions.by_distance(PRICING_REGIONS, place[:2])[0].region if place \
            else PRICING_REGIONS[0]
        for text in self._account.pages(
                'pricing', near, 'get_products', 'PriceList',
                'asking for the prices', ServiceCode='AmazonEC2', FormatVersion='aws_v1',
                Filters=[{'Type': 'TERM_MATCH', 'Field': field, 'Value': value}
                         for field, value in wanted.items()]):
            for kind, price in on_demand_price(str(text)):
                prices[kind] = min(price, prices.get(kind, price))
        return prices

    def spot_prices(
        self, region: str, names: Optional[Sequence[str]],
    ) -> dict[str, dict[str, Decimal]]:
        prices: dict[str, dict[str, Decimal]] = {}
        # a history from now on has only the current prices
        arguments: dict[str, Any] = {
            'StartTime': time.time(), 'ProductDescriptions': [SPOT_PRODUCT]}
        if names is not None:
            arguments['InstanceTypes'] = list(names)
        for entry in self._account.pages(
                'ec2', region, 'describe_spot_price_history', 'SpotPriceHistory',
                'asking for the spot prices', **arguments):
            # should there be more, the newest comes first
            prices.setdefault(entry['InstanceType'], {}).setdefault(
                entry['AvailabilityZone'], Decimal(entry['SpotPrice']))
        return prices


def instance_type(entry: Mapping[str, Any]) -> Optional[MachineType]:
    """Convert an entry of DescribeInstanceTypes; return None if it does not run our Linux."""
    architectures = entry['ProcessorInfo'].get('SupportedArchitectures', [])
    arch = next((name for name in ('x86_64', 'arm64') if name in architectures), None)
    if arch is None or 'ebs' not in entry.get('SupportedRootDeviceTypes', ['ebs']):
        return None
    threads, gpus = entry['VCpuInfo'], entry.get('GpuInfo', {}).get('Gpus', [])
    return MachineType(
        entry['InstanceType'], int(threads['DefaultVCpus']),
        int(threads.get('DefaultCores', threads['DefaultVCpus'])),
        entry['MemoryInfo']['SizeInMiB'] / 1024, arch,
        entry['ProcessorInfo'].get('Manufacturer', ''),
        sum(int(gpu.get('Count', 1)) for gpu in gpus if gpu.get('GpuPartitionSize', 1) >= 1),
        f"{gpus[0].get('Manufacturer', '')} {gpus[0].get('Name', '')}".strip() if gpus else '',
        round(gpus[0].get('MemoryInfo', {}).get('SizeInMiB', 0) / 1024, 1) if gpus else 0.0,
        'spot' in entry.get('SupportedUsageClasses', []))


def on_demand_price(text: str) -> Iterator[tuple[str, Decimal]]:
    """
    Yield type and price in US dollars per hour of an entry of GetProducts' list.

    :raises ProviderError: the entry has another form.
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
