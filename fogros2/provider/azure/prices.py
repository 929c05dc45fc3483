# SPDX-License-Identifier: Apache-2.0
"""Sizes of machines as Azure's API lists them, and Azure's public retail prices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
import os
import re
from typing import Any, Optional

from fogros2.errors import ProviderError
from fogros2.provider.azure.account import Account, endpoint
from fogros2.provider.azure.machines import region_of
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import VmCloud

PRICES_VARIABLE = 'FOGROS2_AZURE_PRICES'
PRICES = 'https://prices.azure.com/api/retail/prices'
#: GB of a GPU by its name in a size's name; sizes of the first generations lack the name.
_GPUS = {'T4': 16.0, 'A10': 24.0, 'A100': 80.0, 'H100': 80.0, 'H200': 141.0, 'V100': 16.0,
         'M60': 8.0, 'MI300X': 192.0, 'V710': 24.0, 'MI25': 16.0}
_NAME = re.compile(r'Standard_([A-Z]+)\d+(?:-\d+)?([a-z]*)')


class AzurePrices(VmCloud):
    """The part of Azure that has sizes and prices."""

    _account: Account

    def account_key(self) -> str:
        return '|'.join((endpoint(), os.environ.get(PRICES_VARIABLE, ''),
                         os.environ.get('AZURE_SUBSCRIPTION_ID', '')))

    def sizes(self, region: str) -> dict[str, Mapping[str, Any]]:
        """
        Return the sizes that the subscription may use in a region; asked once in a process.

        Confidential sizes are left out, because they take only requests with a security profile.
        """
        return self._account.once(f'sizes {region}', lambda: {
            entry['name']: entry for entry in self._account.pages(
                self._account.path(rest='providers/Microsoft.Compute/skus'),
                f'asking for the sizes in {region}', **{'$filter': f"location eq '{region}'"})
            if entry['resourceType'] == 'virtualMachines'
            and 'ConfidentialComputingType' not in capabilities(entry) and not any(
                limit.get('type') == 'Location' for limit in entry.get('restrictions') or ())})

    def types(self, region: str) -> Iterator[MachineType]:
        yield from map(machine_type, self.sizes(region).values())

    def prices(self, region: str, name: str = '') -> dict[str, Decimal]:
        return {kind: price for kind, price, spot in self._retail(region, name) if not spot}

    def spot_prices(
        self, region: str, names: Optional[Sequence[str]],
    ) -> dict[str, dict[str, Decimal]]:
        one = names[0] if names and len(names) == 1 else ''
        return {kind: {region: price} for kind, price, spot in self._retail(region, one) if spot}

    def _retail(self, region: str, name: str) -> list[tuple[str, Decimal, bool]]:
        # one list has both kinds of prices
        query = (f"serviceName eq 'Virtual Machines' and priceType eq 'Consumption' and "
                 f"armRegionName eq '{region}'" + f" and armSkuName eq '{name}'" * bool(name))
        return self._account.once(f'prices {region} {name}', lambda: [
            price for entry in self._account.public(
                os.environ.get(PRICES_VARIABLE, PRICES), f'asking for the prices in {region}',
                {'$filter': query}) if (price := retail_price(entry)) is not None])


def capabilities(entry: Mapping[str, Any]) -> dict[str, str]:
    """Return the capabilities of a size."""
    return {one['name']: one['value'] for one in entry.get('capabilities') or ()}


def machine_type(entry: Mapping[str, Any]) -> MachineType:
    """Convert a size."""
    has, name = capabilities(entry), str(entry['name'])
    arm = has.get('CpuArchitectureType') == 'Arm64'
    cpus = int(has.get('vCPUsAvailable') or has['vCPUs'])
    parts, gpus = _NAME.match(name), int(has.get('GPUs', '0'))
    family, features = (parts[1], parts[2]) if parts else ('', '')
    word = next((word for word in _GPUS if re.search(rf'{word}(_|$)', name)), '')
    if gpus and not word:
        word = 'MI25' if features.startswith('as') and family == 'NV' else \
            'M60' if family == 'NV' else 'V100'
    maker = 'AMD' if word.startswith(('MI', 'V7')) else 'NVIDIA'
    return MachineType(
        name, cpus, max(1, cpus // int(has.get('vCPUsPerCore') or 1)), float(has['MemoryGB']),
        'arm64' if arm else 'x86_64', 'ARM' if arm else 'AMD' if 'a' in features else 'Intel',
        gpus, f'{maker} {word}' if gpus else '', _GPUS.get(word, 0.0) if gpus else 0.0,
        has.get('LowPriorityCapable') == 'True')


def generation(entry: Mapping[str, Any]) -> str:
    """Return the newest generation of virtual machines that a size supports."""
    return 'V2' if 'V2' in capabilities(entry).get('HyperVGenerations', 'V2') else 'V1'


def is_in(entry: Mapping[str, Any], region: str) -> bool:
    """Return whether a resource is in a region; '' is every region."""
    return region in ('', region_of(entry))


def retail_price(entry: Mapping[str, Any]) -> Optional[tuple[str, Decimal, bool]]:
    """
    Return size, price in US dollars per hour and whether it is a spot price.

    None for another operating system, and for what is no virtual machine of the standard kind.

    :raises ProviderError: the entry has another form.
    """
    try:
        product, sku = str(entry['productName']), str(entry['skuName'])
        if product.endswith('Windows') or 'Cloud Services' in product or 'Low Priority' in sku \
                or entry['unitOfMeasure'] != '1 Hour' or not entry.get('armSkuName') \
                or not entry['retailPrice'] or entry.get('currencyCode', 'USD') != 'USD':
            return None
        return (str(entry['armSkuName']), Decimal(str(entry['retailPrice'])),
                sku.endswith(' Spot'))
    except (KeyError, TypeError, ArithmeticError) as error:
        raise ProviderError(f"Azure's list of prices can't be read: {error!r}") from error
