# SPDX-License-Identifier: Apache-2.0
"""
What Moto doesn't know: prices, spot prices, and which AMI is today's Ubuntu; pure.

The forms are those of the Price List API, DescribeSpotPriceHistory and SSM's public parameters;
the figures are of the order of AWS's and hold in a box alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import dataclasses
import datetime
from decimal import Decimal
import hashlib
import json
import re
from typing import Optional

#: Regions that every account has; the others have to be enabled first, which nobody has done.
ENABLED = (
    'ap-northeast-1', 'ap-northeast-2', 'ap-northeast-3', 'ap-south-1', 'ap-southeast-1',
    'ap-southeast-2', 'ca-central-1', 'eu-central-1', 'eu-north-1', 'eu-west-1', 'eu-west-2',
    'eu-west-3', 'sa-east-1', 'us-east-1', 'us-east-2', 'us-west-1', 'us-west-2')
#: US dollars an hour in us-east-1.
PRICES: Mapping[str, str] = {
    't3.micro': '0.0104', 't3.small': '0.0208', 't3.medium': '0.0416', 't3.large': '0.0832',
    't3.xlarge': '0.1664', 't3a.medium': '0.0376', 't4g.small': '0.0168', 't4g.medium': '0.0336',
    't4g.large': '0.0672', 'm5.large': '0.0960', 'm5.xlarge': '0.1920', 'm6i.large': '0.0960',
    'm7g.large': '0.0816', 'c5.large': '0.0850', 'c5.xlarge': '0.1700', 'c5.2xlarge': '0.3400',
    'c5.4xlarge': '0.6800', 'c6i.2xlarge': '0.3400', 'c7g.xlarge': '0.1450',
    'c7a.large': '0.1026', 'm7a.large': '0.1159', 't2.medium': '0.0464', 'r5.large': '0.1260',
    'g4dn.xlarge': '0.5260', 'g5.xlarge': '1.0060', 'g6.xlarge': '0.8048',
}
#: How much dearer other regions are; those not named cost a quarter more.
_FACTORS: Mapping[str, str] = {
    'us-east-1': '1', 'us-east-2': '1', 'us-west-2': '1', 'us-west-1': '1.17',
    'eu-west-1': '1.09', 'eu-central-1': '1.15', 'eu-north-1': '1.04', 'ap-south-1': '1.07',
}
_SPOT_SHARES = (Decimal('0.31'), Decimal('0.34'), Decimal('0.38'))

_PARAMETERS = (
    (re.compile(r'/aws/service/canonical/ubuntu/server/([0-9.]+)/stable/current/(amd64|arm64)'
                r'/hvm/ebs-gp[23]/ami-id'), 'ubuntu'),
    (re.compile(r'/aws/service/deeplearning/ami/(x86_64|arm64)/([a-z0-9.-]+)/latest/ami-id'),
     'deep-learning'),
)


@dataclasses.dataclass(frozen=True)
class PublicImage:
    """An AMI that somebody publishes; ``size_gb`` is its disk's."""

    id: str
    name: str
    architecture: str
    owner: str
    size_gb: int = 8


def price(region: str, kind: str) -> Optional[Decimal]:
    """Return what a type costs by the hour, None where it isn't sold."""
    if kind not in PRICES:
        return None
    return Decimal(PRICES[kind]) * Decimal(_FACTORS.get(region, '1.25'))


def spot_price(region: str, kind: str, zone: str) -> Optional[Decimal]:
    """Return what a type costs by the hour as a spot instance in a zone now."""
    whole = price(region, kind)
    if whole is None:
        return None
    return (whole * _SPOT_SHARES[ord(zone[-1]) % 3]).quantize(Decimal('0.000001'))


def products(wanted: Mapping[str, str]) -> Iterator[str]:
    """Yield GetProducts' entries, JSON each, whose attributes are the ``wanted`` ones."""
    region = wanted['regionCode']
    for kind in PRICES:
        for system in ('Linux', 'Windows'):
            attributes = {
                'regionCode': region, 'instanceType': kind, 'operatingSystem': system,
                'tenancy': 'Shared', 'preInstalledSw': 'NA', 'capacitystatus': 'Used',
                'marketoption': 'OnDemand'}
            if all(attributes.get(field) == value for field, value in wanted.items()):
                yield _product(region, kind, system, attributes)


def _product(region: str, kind: str, system: str, attributes: Mapping[str, str]) -> str:
    sku = hashlib.sha256(f'{region} {kind} {system}'.encode()).hexdigest()[:16].upper()
    cost = (price(region, kind) or Decimal(0)) * (2 if system == 'Windows' else 1)
    term, rate = f'{sku}.JRTCKXETXF', f'{sku}.JRTCKXETXF.6YS6EN2CT7'
    return json.dumps({
        'product': {'productFamily': 'Compute Instance', 'attributes': dict(attributes),
                    'sku': sku},
        'serviceCode': 'AmazonEC2',
        'terms': {'OnDemand': {term: {
            'priceDimensions': {rate: {
                'unit': 'Hrs', 'rateCode': rate, 'pricePerUnit': {'USD': f'{cost:.10f}'}}},
            'sku': sku, 'offerTermCode': 'JRTCKXETXF'}}}})


def spot_history(
    region: str, kinds: Iterable[str], offered: Mapping[str, Iterable[str]],
    when: datetime.datetime,
) -> str:
    """
    Return DescribeSpotPriceHistory's items as XML.

    :param offered: the zones that have each type.
    """
    items = []
    for kind in kinds:
        for zone in offered.get(kind, ()):
            cost = spot_price(region, kind, zone)
            if cost is not None:
                items.append(
                    f'<item><instanceType>{kind}</instanceType>'
                    '<productDescription>Linux/UNIX</productDescription>'
                    f'<spotPrice>{cost}</spotPrice><availabilityZone>{zone}</availabilityZone>'
                    f'<timestamp>{when:%Y-%m-%dT%H:%M:%S.000Z}</timestamp></item>')
    return f'<spotPriceHistorySet>{"".join(items)}</spotPriceHistorySet><nextToken/>'


def image_of(parameter: str, region: str) -> Optional[PublicImage]:
    """Return the AMI that a public SSM parameter names, None if there is no such parameter."""
    for pattern, kind in _PARAMETERS:
        found = pattern.fullmatch(parameter)
        if not found:
            continue
        architecture = 'arm64' if 'arm64' in parameter else 'x86_64'
        number = hashlib.sha256(f'{region} {parameter}'.encode()).hexdigest()[:17]
        if kind == 'ubuntu':
            return PublicImage(
                f'ami-{number}', f'ubuntu/images/hvm-ssd-gp3/ubuntu-{found[1]}-server',
                architecture, '099720109477')
        return PublicImage(f'ami-{number}', f'Deep Learning {found[2]}', architecture,
                           '898082745236', 60)
    return None
