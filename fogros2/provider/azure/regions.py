# SPDX-License-Identifier: Apache-2.0
"""The regions of Azure."""

from __future__ import annotations

#: Regions: latitude and longitude in degrees, a place for people, and whether every account may
#: use the region; False if Azure has to enable it first.
REGIONS: dict[str, tuple[float, float, str, bool]] = {
    'australiacentral': (-35.3, 149.1, 'Canberra', True),
    'australiaeast': (-33.9, 151.2, 'Sydney', True),
    'australiasoutheast': (-37.8, 145.0, 'Melbourne', True),
    'austriaeast': (48.2, 16.4, 'Vienna', True),
    'belgiumcentral': (50.8, 4.4, 'Brussels', True),
    'brazilsouth': (-23.6, -46.6, 'Sao Paulo', True),
    'canadacentral': (43.7, -79.4, 'Toronto', True),
    'canadaeast': (46.8, -71.2, 'Quebec', True),
    'centralindia': (18.6, 73.9, 'Pune', True),
    'centralus': (41.6, -93.6, 'Iowa', True),
    'chilecentral': (-33.4, -70.7, 'Santiago', True),
    'eastasia': (22.3, 114.2, 'Hong Kong', True),
    'eastus': (37.4, -79.8, 'Virginia', True),
    'eastus2': (36.7, -78.4, 'Virginia', True),
    'francecentral': (48.9, 2.4, 'Paris', True),
    'francesouth': (43.3, 5.4, 'Marseille', False),
    'germanynorth': (53.1, 8.8, 'Berlin', False),
    'germanywestcentral': (50.1, 8.7, 'Frankfurt', True),
    'indonesiacentral': (-6.2, 106.8, 'Jakarta', True),
    'israelcentral': (32.1, 34.8, 'Tel Aviv', True),
    'italynorth': (45.5, 9.2, 'Milan', True),
    'japaneast': (35.7, 139.8, 'Tokyo', True),
    'japanwest': (34.7, 135.5, 'Osaka', True),
    'koreacentral': (37.6, 127.0, 'Seoul', True),
    'koreasouth': (35.2, 129.0, 'Busan', True),
    'malaysiawest': (3.1, 101.7, 'Kuala Lumpur', True),
    'mexicocentral': (20.6, -100.4, 'Queretaro', True),
    'newzealandnorth': (-36.8, 174.8, 'Auckland', True),
    'northcentralus': (41.9, -87.6, 'Illinois', True),
    'northeurope': (53.3, -6.3, 'Dublin', True),
    'norwayeast': (59.9, 10.8, 'Oslo', True),
    'polandcentral': (52.2, 21.0, 'Warsaw', True),
    'qatarcentral': (25.3, 51.5, 'Doha', True),
    'southafricanorth': (-26.2, 28.2, 'Johannesburg', True),
    'southcentralus': (29.4, -98.5, 'Texas', True),
    'southeastasia': (1.3, 103.8, 'Singapore', True),
    'southindia': (13.0, 80.2, 'Chennai', True),
    'spaincentral': (40.4, -3.7, 'Madrid', True),
    'swedencentral': (60.7, 17.1, 'Gavle', True),
    'switzerlandnorth': (47.5, 8.6, 'Zurich', True),
    'uaenorth': (25.3, 55.3, 'Dubai', True),
    'uksouth': (50.9, -0.8, 'London', True),
    'ukwest': (51.5, -3.2, 'Cardiff', True),
    'westcentralus': (40.9, -110.2, 'Wyoming', True),
    'westeurope': (52.4, 4.9, 'Amsterdam', True),
    'westus': (37.8, -122.4, 'California', True),
    'westus2': (47.2, -119.9, 'Washington', True),
    'westus3': (33.4, -112.1, 'Phoenix', True),
}


def api_host(region: str) -> str:
    """Return a host of Azure that is in the region."""
    return f'{region}.handler.control.monitor.azure.com'
