# SPDX-License-Identifier: Apache-2.0
"""What Google offers in a box: zones, machine types, public images. The figures are Google's."""

from __future__ import annotations

from typing import Any

ZONES = {
    'us-central1': ('a', 'b', 'c', 'f'), 'us-east1': ('b', 'c', 'd'),
    'europe-west3': ('a', 'b', 'c'), 'europe-west1': ('b', 'c', 'd')}
#: vCPUs, memory in MiB, architecture, accelerators.
TYPES: dict[str, tuple[int, int, str, tuple[str, int]]] = {
    'e2-micro': (2, 1024, 'X86_64', ('', 0)), 'e2-medium': (2, 4096, 'X86_64', ('', 0)),
    'e2-standard-4': (4, 16384, 'X86_64', ('', 0)),
    'n1-standard-1': (1, 3840, 'X86_64', ('', 0)),
    'n1-standard-4': (4, 15360, 'X86_64', ('', 0)),
    'n2-standard-2': (2, 8192, 'X86_64', ('', 0)), 'c4-standard-2': (2, 7168, 'X86_64', ('', 0)),
    't2a-standard-1': (1, 4096, 'ARM64', ('', 0)),
    'g2-standard-4': (4, 16384, 'X86_64', ('nvidia-l4', 1)),
    'g2-standard-8': (8, 32768, 'X86_64', ('nvidia-l4', 1))}
#: Types that only one zone of a region has.
RARE = {'g2-standard-4': 'b', 'g2-standard-8': 'b', 't2a-standard-1': 'a'}
#: GPUs, and the zones without them.
ACCELERATORS = {'nvidia-tesla-t4': ('us-east1-b',), 'nvidia-l4': ()}
DISK_TYPES = ('pd-standard', 'pd-balanced', 'pd-ssd', 'hyperdisk-balanced')
#: Public images: project, name, family, architecture, size in GB.
IMAGES = (
    ('ubuntu-os-cloud', 'ubuntu-2404-noble-amd64-v20260101', 'ubuntu-2404-lts-amd64', 'X86_64',
     10),
    ('ubuntu-os-cloud', 'ubuntu-2404-noble-arm64-v20260101', 'ubuntu-2404-lts-arm64', 'ARM64', 10),
    ('ubuntu-os-cloud', 'ubuntu-2204-jammy-v20220712a', 'ubuntu-2204-lts', 'X86_64', 10),
    ('ubuntu-os-accelerator-images', 'ubuntu-accelerator-2404-amd64-with-nvidia-580-v20260101',
     'ubuntu-accelerator-2404-amd64-with-nvidia-580', 'X86_64', 20))
def zones() -> list[str]:
    """Return the names of all zones."""
    return [f'{region}-{letter}' for region, letters in ZONES.items() for letter in letters]


def machine_types(zone: str) -> dict[str, dict[str, Any]]:
    """Return the machine types of a zone, as the API reports them."""
    found = {}
    for number, (name, (cpus, memory, arch, (gpu, count))) in enumerate(TYPES.items(), 1):
        if RARE.get(name, zone[-1]) == zone[-1]:
            found[name] = {
                'kind': 'compute#machineType', 'id': str(number), 'name': name, 'zone': zone,
                'guestCpus': cpus, 'memoryMb': memory, 'architecture': arch,
                'isSharedCpu': name in ('e2-micro', 'e2-medium'),
                'description': f'{cpus} vCPUs, {memory // 1024} GB RAM',
                'maximumPersistentDisks': 128, 'maximumPersistentDisksSizeGb': '263168',
                'creationTimestamp': '1969-12-31T16:00:00.000-08:00',
                **({'accelerators': [{'guestAcceleratorType': gpu,
                                      'guestAcceleratorCount': count}]} if gpu else {})}
    return found


#: Google's rules in a new network called 'default', each at priority 65534.
ANYWHERE, INTERNAL = '0.0.0.0/0', '198.51.100.128/25'  # here, in the place of 10.128.0.0/9
DEFAULT_RULES: tuple[tuple[str, str, str, list[str]], ...] = (
    ('internal', INTERNAL, 'tcp', ['0-65535']), ('internal-udp', INTERNAL, 'udp', ['0-65535']),
    ('ssh', ANYWHERE, 'tcp', ['22']), ('rdp', ANYWHERE, 'tcp', ['3389']),
    ('icmp', ANYWHERE, 'icmp', []))

#: Key of the catalogue of prices in a box.
API_KEY = 'AIza-in-a-box'
#: Entries of the catalogue: description, region, dollars an hour, two tiers if it is free first.
SKUS = (
    ('E2 Instance Core running in Frankfurt', 'europe-west3', '0.02810370'),
    ('E2 Instance Ram running in Frankfurt', 'europe-west3', '0.00376602'),
    ('Spot Preemptible E2 Instance Core running in Frankfurt', 'europe-west3', '0.00562350'),
    ('Spot Preemptible E2 Instance Ram running in Frankfurt', 'europe-west3', '0.00075210'),
    ('N1 Predefined Instance Core running in Frankfurt', 'europe-west3', '0.04073000'),
    ('N1 Predefined Instance Ram running in Frankfurt', 'europe-west3', '0.00545800'),
    ('N2 Instance Core running in Frankfurt', 'europe-west3', '0.04073000'),
    ('N2 Instance Ram running in Frankfurt', 'europe-west3', '0.00545800'),
    ('Nvidia Tesla T4 GPU running in Frankfurt', 'europe-west3', '0.41000000'),
    ('Nvidia Tesla T4 GPU attached to Spot Preemptible VMs running in Frankfurt', 'europe-west3',
     '0.12000000'),
    ('Nvidia Tesla T4 GPU attached to DWS Defined Duration VMs running in Frankfurt',
     'europe-west3', '9.00000000'),
    ('G2 Instance Core running in Frankfurt', 'europe-west3', '0.03220000'),
    ('G2 Instance Ram running in Frankfurt', 'europe-west3', '0.00377000'),
    ('Nvidia L4 GPU running in Frankfurt', 'europe-west3', '0.72000000'),
    ('E2 Custom Instance Core running in Frankfurt', 'europe-west3', '9.00000000'),
    ('N2 Sole Tenancy Instance Core running in Frankfurt', 'europe-west3', '9.00000000'),
    ('Commitment v1: N2 Cpu in Frankfurt for 1 Year', 'europe-west3', '9.00000000'),
    ('Storage PD Capacity in Frankfurt', 'europe-west3', '0.04800000'))


def skus() -> list[dict[str, Any]]:
    """Return the entries of Google's catalogue of prices."""
    found = []
    for number, (text, region, dollars) in enumerate(SKUS):
        units, _, nanos = dollars.partition('.')
        found.append({
            'name': f'services/6F81-5844-456A/skus/{number}', 'skuId': str(number),
            'description': text, 'serviceRegions': [region],
            'pricingInfo': [{'pricingExpression': {'tieredRates': [{
                'startUsageAmount': 0, 'unitPrice': {
                    'currencyCode': 'USD', 'units': units, 'nanos': int(f'{nanos}0')}}]}}]})
    return found
