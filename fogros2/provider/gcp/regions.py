# SPDX-License-Identifier: Apache-2.0
"""The regions of Google Cloud."""

from __future__ import annotations

#: Regions: latitude and longitude in degrees, a place for people, and whether every project may
#: use the region.
REGIONS: dict[str, tuple[float, float, str, bool]] = {
    'africa-south1': (-26.2, 28.0, 'Johannesburg', True),
    'asia-east1': (24.1, 120.5, 'Changhua', True),
    'asia-east2': (22.3, 114.2, 'Hong Kong', True),
    'asia-northeast1': (35.7, 139.7, 'Tokyo', True),
    'asia-northeast2': (34.7, 135.5, 'Osaka', True),
    'asia-northeast3': (37.6, 127.0, 'Seoul', True),
    'asia-south1': (19.1, 72.9, 'Mumbai', True),
    'asia-south2': (28.6, 77.2, 'Delhi', True),
    'asia-southeast1': (1.4, 103.8, 'Singapore', True),
    'asia-southeast2': (-6.2, 106.8, 'Jakarta', True),
    'australia-southeast1': (-33.9, 151.2, 'Sydney', True),
    'australia-southeast2': (-37.8, 145.0, 'Melbourne', True),
    'europe-central2': (52.2, 21.0, 'Warsaw', True),
    'europe-north1': (60.6, 27.1, 'Hamina', True),
    'europe-north2': (59.3, 18.1, 'Stockholm', True),
    'europe-southwest1': (40.4, -3.7, 'Madrid', True),
    'europe-west1': (50.5, 3.8, 'St. Ghislain', True),
    'europe-west10': (52.5, 13.4, 'Berlin', True),
    'europe-west12': (45.1, 7.7, 'Turin', True),
    'europe-west2': (51.5, -0.1, 'London', True),
    'europe-west3': (50.1, 8.7, 'Frankfurt', True),
    'europe-west4': (53.4, 6.8, 'Eemshaven', True),
    'europe-west6': (47.4, 8.5, 'Zurich', True),
    'europe-west8': (45.5, 9.2, 'Milan', True),
    'europe-west9': (48.9, 2.4, 'Paris', True),
    'me-central1': (25.3, 51.5, 'Doha', True),
    'me-central2': (26.4, 50.1, 'Dammam', False),
    'me-west1': (32.1, 34.8, 'Tel Aviv', True),
    'northamerica-northeast1': (45.5, -73.6, 'Montreal', True),
    'northamerica-northeast2': (43.7, -79.4, 'Toronto', True),
    'northamerica-south1': (20.6, -100.4, 'Queretaro', True),
    'southamerica-east1': (-23.5, -46.6, 'Sao Paulo', True),
    'southamerica-west1': (-33.4, -70.7, 'Santiago', True),
    'us-central1': (41.3, -95.9, 'Iowa', True),
    'us-east1': (33.2, -80.0, 'South Carolina', True),
    'us-east4': (39.0, -77.5, 'Virginia', True),
    'us-east5': (40.0, -83.0, 'Ohio', True),
    'us-south1': (32.8, -96.8, 'Dallas', True),
    'us-west1': (45.6, -121.2, 'Oregon', True),
    'us-west2': (34.1, -118.2, 'Los Angeles', True),
    'us-west3': (40.8, -111.9, 'Salt Lake City', True),
    'us-west4': (36.2, -115.1, 'Las Vegas', True),
}


def api_host(region: str) -> str:
    """Return the host of a region's own endpoint, which is in the region."""
    return f'compute.{region}.rep.googleapis.com'
