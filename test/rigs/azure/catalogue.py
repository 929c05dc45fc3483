# SPDX-License-Identifier: Apache-2.0
"""What the simulated Azure sells: regions, sizes, images and prices, in the shapes of its API."""

from __future__ import annotations

from typing import Any

REGIONS = ('eastus', 'germanywestcentral', 'westeurope')
#: Name: vCPUs, memory in GB, architecture, GPUs, spot, dollars per hour on demand and as spot.
SIZES: dict[str, tuple[int, float, str, int, bool, str, str]] = {
    'Standard_B2als_v2': (2, 4.0, 'x64', 0, True, '0.0376', '0.0094'),
    'Standard_B2pls_v2': (2, 4.0, 'Arm64', 0, True, '0.0336', '0.0084'),
    'Standard_D2s_v5': (2, 8.0, 'x64', 0, True, '0.096', '0.0192'),
    'Standard_D8s_v5': (8, 32.0, 'x64', 0, True, '0.384', '0.0768'),
    'Standard_NC4as_T4_v3': (4, 28.0, 'x64', 1, True, '0.526', '0.1052'),
    'Standard_DS2_v2': (2, 7.0, 'x64', 0, False, '0.146', ''),
    'Standard_DC2as_v5': (2, 8.0, 'x64', 0, True, '0.0076', '0.0019'),
    'Standard_D2s_v6': (2, 8.0, 'x64', 0, True, '0.101', '0.0202'),
}
#: Further capabilities of a size: a confidential one, and one whose disks are NVMe alone.
CAPABILITIES = {'Standard_DC2as_v5': {'ConfidentialComputingType': 'SNP'},
                'Standard_D2s_v6': {'DiskControllerTypes': 'NVMe'}}
#: Marketplace images: what fits to 'publisher:offer:sku', and GB of the disk.
IMAGES = {
    'Canonical:ubuntu-24_04-lts:server': ('x64', 'V2', 30),
    'Canonical:ubuntu-24_04-lts:server-gen1': ('x64', 'V1', 30),
    'Canonical:ubuntu-24_04-lts:server-arm64': ('Arm64', 'V2', 30),
}


def skus(region: str, restricted: set[str]) -> list[dict[str, Any]]:
    """Return the sizes of a region; a restricted one is listed with the restriction."""
    found: list[dict[str, Any]] = [{'resourceType': 'disks', 'name': 'Premium_LRS',
                                    'locations': [region], 'restrictions': []}]
    for name, (cpus, memory, arch, gpus, spot, _, _) in SIZES.items():
        has = {'vCPUs': str(cpus), 'MemoryGB': f'{memory:g}', 'CpuArchitectureType': arch,
               'vCPUsAvailable': str(cpus), 'vCPUsPerCore': '1' if arch == 'Arm64' else '2',
               'HyperVGenerations': 'V2' if arch == 'Arm64' else 'V1,V2', 'PremiumIO': 'True',
               'LowPriorityCapable': str(spot), **({'GPUs': str(gpus)} if gpus else {}),
               **CAPABILITIES.get(name, {})}
        found.append({
            'resourceType': 'virtualMachines', 'name': name, 'tier': 'Standard',
            'size': name.partition('_')[2], 'family': 'standardFamily', 'locations': [region],
            'capabilities': [{'name': key, 'value': value} for key, value in has.items()],
            'locationInfo': [{'location': region, 'zones': ['1', '2', '3']}],
            'restrictions': [{'type': 'Location', 'values': [region],
                              'reasonCode': 'NotAvailableForSubscription'}]
            if name in restricted else []})
    return found


def retail(region: str) -> list[dict[str, Any]]:
    """Return entries of the retail price list, those of no use for us included."""
    def entry(name: str, price: str, product: str, sku: str) -> dict[str, Any]:
        return {'currencyCode': 'USD', 'retailPrice': float(price), 'unitPrice': float(price),
                'armRegionName': region, 'productName': f'Virtual Machines {product}',
                'skuName': sku, 'armSkuName': name, 'serviceName': 'Virtual Machines',
                'unitOfMeasure': '1 Hour', 'type': 'Consumption', 'isPrimaryMeterRegion': True}

    found = []
    for name, (*_, price, spot) in SIZES.items():
        short = name.partition('_')[2].replace('_', ' ')
        found += [entry(name, price, 'Series', short),
                  entry(name, str(float(price) * 2), 'Series Windows', short)]
        if spot:
            found += [entry(name, spot, 'Series', f'{short} Spot'),
                      entry(name, '0.001', 'Series', f'{short} Low Priority')]
    return found
