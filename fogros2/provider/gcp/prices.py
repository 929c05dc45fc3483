# SPDX-License-Identifier: Apache-2.0
"""
Prices by Google's Cloud Billing Catalog, which takes an API key.

The catalogue sells processors, memory and GPUs of each family of machine types by the hour. A
type costs the sum of its parts. Source: ``services.skus.list`` of the Cloud Billing API.
"""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
import functools
import os
import re
import threading
from typing import Any, Optional

from fogros2.errors import ProviderError

KEY_VARIABLE = 'FOGROS2_GCP_API_KEY'
ENDPOINT = 'https://cloudbilling.googleapis.com/'
ENDPOINT_VARIABLE = 'CLOUDSDK_API_ENDPOINT_OVERRIDES_CLOUDBILLING'
#: Compute Engine's number in the catalogue.
_SERVICE = 'v1/services/6F81-5844-456A/skus'
_FIELDS = 'nextPageToken,skus(description,serviceRegions,' \
    'pricingInfo/pricingExpression/tieredRates)'
_PART = re.compile(r'(Spot Preemptible )?(?:(?P<family>[A-Z]\d+[A-Z]?) (?:AMD |Arm |Predefined )?'
                   r'Instance (?P<part>Core|Ram)|(?P<gpu>Nvidia [\w ]+) GPU)'
                   r'(?P<attached> attached to Spot Preemptible VMs)? running in .*')
#: vCPUs for which Google bills a type that shares its core.
_SHARED = {'e2-micro': Decimal('0.25'), 'e2-small': Decimal('0.5'), 'e2-medium': Decimal(1)}

#: Dollars per hour by region, family or GPU, part ('Core', 'Ram', 'GPU'), and whether spot.
Rates = Mapping[tuple[str, str, str, bool], Decimal]


def rates() -> Rates:
    """
    Return the prices of all parts, asked once in a process: a few seconds.

    :raises ProviderError: no key is set, or the catalogue refuses it.
    """
    key = os.environ.get(KEY_VARIABLE, '')
    if not key:
        raise ProviderError(
            f"Google's prices are not known here: {KEY_VARIABLE} has no key of its catalogue",
            'name a machine_type= and leave max_price= out, or see doc/gcp.md')
    with _ASKING:
        return _asked(key, os.environ.get(ENDPOINT_VARIABLE, ENDPOINT).rstrip('/') + '/')


#: Held while the catalogue is read: all regions need the same answer.
_ASKING = threading.Lock()


@functools.lru_cache(maxsize=1)
def _asked(key: str, endpoint: str) -> Rates:
    import requests

    table: dict[tuple[str, str, str, bool], Decimal] = {}
    query = {'key': key, 'pageSize': '5000', 'fields': _FIELDS}
    try:
        while True:
            reply = requests.get(f'{endpoint}{_SERVICE}', params=query, timeout=20.0)
            reply.raise_for_status()
            answer = reply.json()
            for sku in answer.get('skus', ()):
                table.update(parts(sku))
            if not answer.get('nextPageToken'):
                return table
            query['pageToken'] = answer['nextPageToken']
    except (requests.RequestException, ValueError, KeyError, IndexError, TypeError) as error:
        # the key is a part of the address
        message = str(error).replace(key, '...')
        raise ProviderError(f"Google's catalogue of prices can't be read: {message[:200]}",
                            f'is {KEY_VARIABLE} a key for the Cloud Billing API?') from None


def parts(sku: Mapping[str, Any]) -> Rates:
    """Return the price of a part in each region that an entry of the catalogue is for."""
    words = _PART.fullmatch(sku['description'])
    if words is None:
        return {}
    name = words['family'] or _gpu(words['gpu'].replace(' ', '-'))
    price = sku['pricingInfo'][0]['pricingExpression']['tieredRates'][-1]['unitPrice']
    dollars = int(price.get('units', 0)) + Decimal(int(price.get('nanos', 0))) / 10**9
    spot = bool(words[1] or words['attached'])
    return {(region, name.lower(), words['part'] or 'GPU', spot): dollars
            for region in sku['serviceRegions']}


def _gpu(name: str) -> str:
    """Return the name of a GPU without 'tesla', which catalogue and types use differently."""
    return name.lower().replace('-tesla-', '-')


def price(
    table: Rates, region: str, entry: Mapping[str, Any], gpus: Mapping[str, int], spot: bool,
) -> Optional[Decimal]:
    """
    Return the price of a type in US dollars per hour, None if a part has none.

    :param entry: the type as machineTypes has it.
    :param gpus: number of attached GPUs by type, besides those of the type.
    """
    family = entry['name'].partition('-')[0]
    own = {gpu['guestAcceleratorType']: gpu['guestAcceleratorCount']
           for gpu in entry.get('accelerators') or ()}
    wanted = [(family, 'Core', _SHARED.get(entry['name'], Decimal(entry['guestCpus']))),
              (family, 'Ram', Decimal(entry['memoryMb']) / 1024),
              *((_gpu(gpu), 'GPU', Decimal(count)) for gpu, count in {**own, **gpus}.items())]
    costs = [(table.get((region, name, part, spot)), count) for name, part, count in wanted]
    if any(cost is None for cost, _ in costs):
        return None
    return sum((cost * count for cost, count in costs if cost is not None), Decimal(0)).normalize()
