# SPDX-License-Identifier: Apache-2.0
"""
Which region is near: by the time that a TCP connection takes, by the globe where none can be made.

The table that comes of it is Table VI of the FogROS2 paper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import dataclasses
import functools
import math
import socket
import statistics
import threading
import time
from typing import Optional

from fogros2.errors import PrerequisiteError, ProviderError

#: Regions, and about where they are: latitude and longitude in degrees, and a name for people.
#: Those that an account has to enable first are marked by False.
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
#: Regions that every account may use.
ENABLED = tuple(name for name, (*_, enabled) in REGIONS.items() if enabled)
#: Regions beside one to go on in where that has no room.
NEIGHBOURS = 2
#: Connections to each region, of which the median counts.
ATTEMPTS = 3
#: Seconds after which one connection counts as failed.
CONNECT_TIMEOUT = 2.0
#: Seconds that all of it may take; look-ups of names have no deadline of their own.
DEADLINE = 5.0
#: Seconds in which a region that is nearer than the first one to answer has answered as well:
#: names take different times to look up.
GRACE = 0.5
#: Says where this computer is, roughly: ``{"loc": "48.2,16.4"}``.
GEOLOCATION_URL = 'https://ipinfo.io/json'

#: Seconds that a TCP connection to a host and port takes, an OSError if there is none.
Connector = Callable[[str, int, float], float]
#: This computer's latitude and longitude in degrees, by whom it knows.
Locator = Callable[[], tuple[float, float]]


@dataclasses.dataclass(frozen=True)
class Latency:
    """
    How far a region is.

    :param milliseconds: median time to connect by TCP: one round trip; None where none came back.
    :param distance_km: along the globe, where that was all there was to go by.
    """

    region: str
    place: str
    milliseconds: Optional[float] = None
    distance_km: Optional[float] = None


def api_host(region: str) -> str:
    """Return the host of a region's EC2 API, which is in the region."""
    suffix = '.cn' if region.startswith('cn-') else ''
    return f'ec2.{region}.amazonaws.com{suffix}'


def connect_time(host: str, port: int, timeout: float) -> float:
    """
    Return the seconds that one TCP connection takes, the name's look-up left out.

    :raises OSError: there is no connection.
    """
    family, kind, protocol, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind, protocol) as connection:
        connection.settimeout(timeout)
        begin = time.perf_counter()
        connection.connect(address)
        return time.perf_counter() - begin


def geolocate() -> tuple[float, float]:
    """
    Return about where this computer is: latitude and longitude in degrees.

    :raises PrerequisiteError: the package 'requests' isn't installed.
    :raises ProviderError: nobody answers, or not in a way that makes sense.
    """
    try:
        import requests
    except ImportError as error:
        raise PrerequisiteError("the nearest region can't be found out without 'requests'",
                                'python3 -m pip install requests, or name a region') from error
    try:
        answer = requests.get(GEOLOCATION_URL, timeout=4.0)
        answer.raise_for_status()
        latitude, longitude = str(answer.json()['loc']).split(',')
        return float(latitude), float(longitude)
    except (requests.ConnectionError, requests.Timeout) as error:
        raise ProviderError(f'{GEOLOCATION_URL}, which would know where this computer is, does '
                            'not answer either', 'name a region') from error
    except (requests.RequestException, ValueError, KeyError, TypeError) as error:
        raise ProviderError(f"{GEOLOCATION_URL} doesn't say where this computer is: {error}",
                            'name a region') from error


def distance_km(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the great-circle distance of two places given in degrees (haversine formula)."""
    latitude, longitude, latitude2, longitude2 = map(math.radians, (*one, *other))
    half = (math.sin((latitude2 - latitude) / 2) ** 2
            + math.cos(latitude) * math.cos(latitude2)
            * math.sin((longitude2 - longitude) / 2) ** 2)
    return 2 * 6371.0 * math.asin(math.sqrt(min(1.0, half)))


def measure(
    regions: Iterable[str] = ENABLED, *, connect: Connector = connect_time,
    attempts: int = ATTEMPTS, timeout: float = CONNECT_TIMEOUT, deadline: float = DEADLINE,
    grace: Optional[float] = None,
) -> list[Latency]:
    """
    Return how far each region is, the nearest first, those that don't answer last.

    All are asked at once, each ``attempts`` times in a row; after ``deadline`` seconds those that
    have answered less often count with what they have.

    :param grace: seconds for which the others are waited for once one has answered as often as
        it should: who wants the nearest alone learns nothing from the far ones.
    """
    names = list(dict.fromkeys(regions))
    times: dict[str, list[float]] = {name: [] for name in names}
    left = threading.Semaphore(0)

    def ask(region: str) -> None:
        try:
            for _ in range(attempts):
                times[region].append(connect(api_host(region), 443, timeout))
        except OSError:
            pass  # what has been measured before counts
        finally:
            left.release()

    for name in names:
        # no pool: its threads would be waited for at the interpreter's end, deadline or not
        threading.Thread(target=ask, args=(name,), name=f'fog-{name}', daemon=True).start()
    end = time.monotonic() + deadline
    for _ in names:
        if not left.acquire(timeout=max(0.0, end - time.monotonic())):
            break
        if grace is not None and any(len(list(times[name])) == attempts for name in names):
            end = min(end, time.monotonic() + grace)
            grace = None
    measured = [Latency(name, place_of(name), _median(list(times[name]))) for name in names]
    return sorted(measured, key=_by_time)


def _median(seconds: Sequence[float]) -> Optional[float]:
    return 1000 * statistics.median(seconds) if seconds else None


def _by_time(latency: Latency) -> tuple[float, str]:
    far = math.inf if latency.milliseconds is None else latency.milliseconds
    return far, latency.region


def place_of(region: str) -> str:
    """Return where a region is, for people; '' where unknown."""
    return REGIONS[region][2] if region in REGIONS else ''


def by_distance(regions: Iterable[str], here: tuple[float, float]) -> list[Latency]:
    """Return regions by their distance from a place; unknown ones are left out."""
    found = [Latency(name, place_of(name), distance_km=distance_km(here, REGIONS[name][:2]))
             for name in regions if name in REGIONS]
    return sorted(found, key=lambda latency: (latency.distance_km or 0.0, latency.region))


def neighbours(region: str) -> list[str]:
    """Return a few regions beside one, the nearest on the globe first; to go on in."""
    here = REGIONS.get(region)
    others = [name for name in ENABLED if name != region]
    return [] if here is None else [
        found.region for found in by_distance(others, here[:2])][:NEIGHBOURS]


def table(
    regions: Iterable[str] = ENABLED, *, connect: Optional[Connector] = None,
    locate: Optional[Locator] = None, grace: Optional[float] = None,
) -> list[Latency]:
    """
    Return the regions with the nearest first: measured, or by geolocation where none answers.

    :param grace: see :func:`measure`.
    :raises ProviderError: no region answers, and nobody knows where this computer is.
    """
    names = list(regions)
    measured = measure(names, connect=connect or connect_time, grace=grace)
    if any(latency.milliseconds is not None for latency in measured):
        return measured
    try:
        placed = by_distance(names, (locate or geolocate)())
    except ProviderError as error:
        raise ProviderError(f'none of {len(names)} AWS regions answers; {error.args[0]}',
                            'is there a way to the internet? region= names one') from error
    if not placed:
        raise ProviderError(f"none of the AWS regions {', '.join(names)} answers",
                            'are their names right?')
    return placed


_measuring = threading.Lock()


@functools.lru_cache(maxsize=8)
def _nearest(regions: tuple[str, ...]) -> str:
    return table(regions, grace=GRACE)[0].region


def nearest(regions: Optional[Sequence[str]] = None) -> str:
    """
    Return the region that answers first; measured once in a process.

    :param regions: those to choose among; None for all that every account may use.
    :raises ProviderError: see :func:`table`.
    """
    with _measuring:  # machines come up in parallel: the first one's answer is all the others'
        return _nearest(tuple(regions) if regions else ENABLED)
