# SPDX-License-Identifier: Apache-2.0
"""The regions of AWS."""

from __future__ import annotations

#: Regions: latitude and longitude in degrees, a place for people, and whether every account may
#: use the region; False if the account has to enable it first.
REGIONS: dict[str, tuple[float, float, str, bool]] = {
    'af-south-1': (-33.9, 18.4, 'Cape Town', False),
    'ap-east-1': (22.3, 114.2, 'Hong Kong', False),
    'ap-east-2': (25.0, 121.5, 'Taipei', False),
    'ap-northeast-1': (35.7, 139.7, 'Tokyo', True),
    'ap-northeast-2': (37.6, 127.0, 'Seoul', True),
    'ap-northeast-3': (34.7, 135.5, 'Osaka', True),
    'ap-south-1': (19.1, 72.9, 'Mumbai', True),
    'ap-south-2': (17.4, 78.5, 'Hyderabad', False),
    'ap-southeast-1': (1.4, 103.8, 'Singapore', True),
    'ap-southeast-2': (-33.9, 151.2, 'Sydney', True),
    'ap-southeast-3': (-6.2, 106.8, 'Jakarta', False),
    'ap-southeast-4': (-37.8, 145.0, 'Melbourne', False),
    'ap-southeast-5': (3.1, 101.7, 'Kuala Lumpur', False),
    'ap-southeast-6': (-36.8, 174.8, 'Auckland', False),
    'ap-southeast-7': (13.8, 100.5, 'Bangkok', False),
    'ca-central-1': (45.5, -73.6, 'Montreal', True),
    'ca-west-1': (51.0, -114.1, 'Calgary', False),
    'eu-central-1': (50.1, 8.7, 'Frankfurt', True),
    'eu-central-2': (47.4, 8.5, 'Zurich', False),
    'eu-north-1': (59.3, 18.1, 'Stockholm', True),
    'eu-south-1': (45.5, 9.2, 'Milan', False),
    'eu-south-2': (41.6, -0.9, 'Aragon', False),
    'eu-west-1': (53.3, -6.3, 'Dublin', True),
    'eu-west-2': (51.5, -0.1, 'London', True),
    'eu-west-3': (48.9, 2.4, 'Paris', True),
    'il-central-1': (32.1, 34.8, 'Tel Aviv', False),
    'me-central-1': (24.5, 54.4, 'Emirates', False),
    'me-south-1': (26.1, 50.6, 'Bahrain', False),
    'mx-central-1': (20.6, -100.4, 'Queretaro', False),
    'sa-east-1': (-23.6, -46.6, 'Sao Paulo', True),
    'us-east-1': (38.0, -78.5, 'Virginia', True),
    'us-east-2': (40.1, -83.0, 'Ohio', True),
    'us-west-1': (37.8, -122.4, 'San Francisco', True),
    'us-west-2': (45.8, -119.7, 'Oregon', True),
}


def api_host(region: str) -> str:
    """Return the host of a region's EC2 API, which is in the region."""
    suffix = '.cn' if region.startswith('cn-') else ''
    return f'ec2.{region}.amazonaws.com{suffix}'
