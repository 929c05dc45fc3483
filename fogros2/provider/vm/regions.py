# SPDX-License-Identifier: Apache-2.0
"""
Measure how near the regions of a cloud are: by the time of a TCP connection, or by the globe.

The resulting table is Table VI of the FogROS2 paper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import csv
import math
from pathlib import Path
import socket
import statistics
import threading
import time
from typing import Optional

from fogros2.errors import ConfigurationError, PrerequisiteError, ProviderError
from fogros2.provider.machine_types import Region

#: Number of neighbours of a region to try if it has no capacity.
NEIGHBOURS = 2
#: Connections to each region, of which the median counts.
ATTEMPTS = 3
#: Time-out of one connection in seconds.
CONNECT_TIMEOUT = 2.0
#: Time-out of the whole measurement in seconds; a look-up of a name has no time-out of its own.
DEADLINE = 5.0
#: Seconds to wait for nearer regions after the first answer: look-ups take different times.
GRACE = 0.5
#: Service that returns this computer's approximate location: ``{"loc": "48.2,16.4"}``.
GEOLOCATION_URL = 'https://ipinfo.io/json'

#: Latitude and longitude in degrees, a place for people, whether every account may use it.
Table = Mapping[str, tuple[float, float, str, bool]]


def connect_time(host: str, port: int, timeout: float) -> float:
    """
    Return the seconds that one TCP connection takes, without the look-up of the name.

    :raises OSError: the connection fails.
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
    Return the approximate latitude and longitude of this computer in degrees.

    :raises PrerequisiteError: the package 'requests' is not installed.
    :raises ProviderError: the service does not answer, or its answer has no location.
    """
    try:
        import requests
    except ImportError as error:
        raise PrerequisiteError("the nearest region can't be found without the package 'requests'",
                                'python3 -m pip install requests, or name a region') from error
    try:
        answer = requests.get(GEOLOCATION_URL, timeout=4.0)
        answer.raise_for_status()
        latitude, longitude = str(answer.json()['loc']).split(',')
        return float(latitude), float(longitude)
    except (requests.ConnectionError, requests.Timeout) as error:
        raise ProviderError(f'{GEOLOCATION_URL}, which returns the location of this computer, '
                            'does not answer either', 'name a region') from error
    except (requests.RequestException, ValueError, KeyError, TypeError) as error:
        raise ProviderError(f'{GEOLOCATION_URL} returned no location of this computer: {error}',
                            'name a region') from error


def distance_km(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the great-circle distance of two places in degrees (haversine formula)."""
    latitude, longitude, latitude2, longitude2 = map(math.radians, (*one, *other))
    half = (math.sin((latitude2 - latitude) / 2) ** 2
            + math.cos(latitude) * math.cos(latitude2)
            * math.sin((longitude2 - longitude) / 2) ** 2)
    return 2 * 6371.0 * math.asin(math.sqrt(min(1.0, half)))


def read_table(beside: str) -> Table:
    """
    Read ``regions.csv``, in which places are in degrees.

    :param beside: a file of the same folder.
    """
    with Path(beside).with_name('regions.csv').open(encoding='utf-8', newline='') as lines:
        _, *rows = csv.reader(lines)
    return {name: (float(latitude), float(longitude), place, everybody == 'yes')
            for name, latitude, longitude, place, everybody in rows}


class Regions:
    """
    The regions of one cloud; thread-safe.

    :param title: the cloud, for messages.
    :param host: returns the host of a region's API, which must be in the region.
    """

    def __init__(self, title: str, table: Table, host: Callable[[str], str]) -> None:
        self.table = table
        #: Regions that every account may use.
        self.enabled = tuple(name for name, (*_, enabled) in table.items() if enabled)
        self._title = title
        self._host = host
        self._lock = threading.Lock()
        self._nearest: dict[tuple[str, ...], str] = {}

    def measure(self, regions: Iterable[str], *, grace: Optional[float] = None) -> list[Region]:
        """
        Return the regions, the nearest first, those without an answer last.

        All regions are asked at the same time, each ``ATTEMPTS`` times in a row. After
        ``DEADLINE`` seconds, a region counts with the answers that it has given.

        :param grace: seconds to wait for the others once one region has given all its answers,
            for a caller that needs only the nearest.
        """
        names, connect = list(dict.fromkeys(regions)), connect_time
        times: dict[str, list[float]] = {name: [] for name in names}
        answers = threading.Semaphore(0)

        def ask(region: str) -> None:
            try:
                for _ in range(ATTEMPTS):
                    times[region].append(connect(self._host(region), 443, CONNECT_TIMEOUT))
            except OSError:
                pass  # earlier measurements count
            finally:
                answers.release()

        for name in names:
            # no pool: the interpreter's exit would wait for its threads
            threading.Thread(target=ask, args=(name,), name=f'fog-{name}', daemon=True).start()
        end = time.monotonic() + DEADLINE
        for _ in names:
            if not answers.acquire(timeout=max(0.0, end - time.monotonic())):
                break
            if grace is not None and any(len(list(times[name])) == ATTEMPTS for name in names):
                end = min(end, time.monotonic() + grace)
                grace = None
        measured = [Region(name, self.place(name), 1000 * statistics.median(times[name])
                           if times[name] else None) for name in names]
        return sorted(measured, key=lambda one: (
            math.inf if one.milliseconds is None else one.milliseconds, one.region))

    def place(self, region: str) -> str:
        """Return the place of a region for people; '' if unknown."""
        return self.table[region][2] if region in self.table else ''

    def by_distance(self, regions: Iterable[str], here: tuple[float, float]) -> list[Region]:
        """Return known regions by their distance from a place."""
        distances = [
            Region(name, self.place(name), distance_km=distance_km(here, self.table[name][:2]))
            for name in regions if name in self.table]
        return sorted(distances, key=lambda one: (one.distance_km or 0.0, one.region))

    def neighbours(self, region: str) -> list[str]:
        """Return a few regions beside one, the nearest on the globe first."""
        if region not in self.table:
            return []
        others = [name for name in self.enabled if name != region]
        return [near.region for near in self.by_distance(
            others, self.table[region][:2])][:NEIGHBOURS]

    def ranked(
        self, regions: Sequence[str] = (), *, every: bool = False, grace: Optional[float] = None,
    ) -> list[Region]:
        """
        Return regions, the nearest first: measured, or by geolocation if none answers.

        :param regions: names; none for all that every account may use.
        :param every: none stands for all regions.
        :param grace: see :meth:`measure`.
        :raises ProviderError: no region answers, and this computer's location is unknown.
        """
        names = list(regions or (self.table if every else self.enabled))
        measured = self.measure(names, grace=grace)
        if any(one.milliseconds is not None for one in measured):
            return measured
        try:
            placed = self.by_distance(names, geolocate())
        except ProviderError as error:
            raise ProviderError(
                f'none of {len(names)} {self._title} regions answers; {error.args[0]}',
                'is there a way to the internet? region= names one') from error
        if not placed:
            raise ProviderError(f"none of the {self._title} regions {', '.join(names)} answers",
                                'are their names right?')
        return placed

    def check(self, names: Iterable[str]) -> None:
        """
        Check that regions exist.

        :raises ConfigurationError: a name is unknown.
        """
        unknown = [name for name in names if name not in self.table]
        if unknown:
            raise ConfigurationError(f"{self._title} has no region {', '.join(unknown)}",
                                     'ros2 fog regions --all shows them')

    def nearest(self, regions: Optional[Sequence[str]] = None) -> str:
        """
        Return the region with the fastest response; measured once in a process.

        :param regions: the candidates; None for all that every account may use.
        :raises ProviderError: see :meth:`ranked`.
        """
        names = tuple(regions or self.enabled)
        with self._lock:  # machines start in parallel: all use the first one's measurement
            if names not in self._nearest:
                self._nearest[names] = self.ranked(names, grace=GRACE)[0].region
            return self._nearest[names]
