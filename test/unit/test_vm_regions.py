# SPDX-License-Identifier: Apache-2.0
"""The nearest region, over a network that a test makes up, and over sockets of the loopback."""

from __future__ import annotations

from collections.abc import Callable
import math
import socket
import threading
import time
from types import SimpleNamespace

import pytest

from fogros2.errors import PrerequisiteError, ProviderError
from fogros2.provider.aws.cloud import Ec2
from fogros2.provider.aws.provider import AWSProvider
from fogros2.provider.machine_types import Region
from fogros2.provider.vm import regions
from fogros2.provider.vm.cloud import CloudError

REGIONS, HOST = Ec2.regions.table, 'ec2.{}.amazonaws.com'.format
AWS = regions.Regions('AWS', REGIONS, HOST)


def connector(seconds: dict[str, list[float]]) -> Callable[[str, int, float], float]:
    """Return one that takes these times for each region in turn; inf is no connection."""
    left = {HOST(name): list(times) for name, times in seconds.items()}

    def connect(host: str, port: int, timeout: float) -> float:
        assert port == 443
        took = left[host].pop(0) if left.get(host) else math.inf
        if took > timeout:
            raise TimeoutError('timed out')
        return took

    return connect


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return what changes the network: how it connects, and other values of the module."""
    def changed(connect_time: Callable[[str, int, float], float], **values: object) -> None:
        for name, value in {'connect_time': connect_time, **values}.items():
            monkeypatch.setattr(regions, name, value)
    return changed


def test_the_median_decides_and_not_the_mean_nor_the_best(network: Callable[..., None]) -> None:
    network(connector({
        'us-west-1': [0.010, 0.040, 0.041], 'us-west-2': [0.020, 0.021, 1.9],
        'eu-west-1': [0.150, 0.150, 0.150]}))
    found = AWS.measure(['us-west-1', 'us-west-2', 'eu-west-1'])
    assert [(one.region, round(one.milliseconds or 0)) for one in found] == [
        ('us-west-2', 21), ('us-west-1', 40), ('eu-west-1', 150)]
    assert found[0].place == 'Oregon'


def test_regions_that_do_not_answer_come_last(network: Callable[..., None]) -> None:
    network(connector({
        'us-west-1': [5.0], 'us-west-2': [0.3, 3.0], 'sa-east-1': [0.2, 0.2, 0.2]}))
    found = AWS.measure(['us-west-1', 'us-west-2', 'sa-east-1'])
    assert [(one.region, one.milliseconds) for one in found] == [
        ('sa-east-1', 200.0), ('us-west-2', 300.0), ('us-west-1', None)]


@pytest.mark.parametrize(('deadline', 'grace'), [(0.2, None), (60.0, 0.1)])
def test_hanging_region_does_not_delay_the_others(
    network: Callable[..., None], deadline: float, grace: float | None,
) -> None:
    over = threading.Event()

    def connect(host: str, port: int, timeout: float) -> float:
        if 'us-east-1' in host:
            over.wait(60)
        return 0.05

    network(connect, DEADLINE=deadline)
    begin = time.monotonic()
    found = AWS.measure(['us-east-1', 'us-west-1'], grace=grace)
    assert time.monotonic() - begin < 30
    assert [(one.region, one.milliseconds) for one in found] == [
        ('us-west-1', 50.0), ('us-east-1', None)]
    over.set()


def test_all_are_asked_at_once(network: Callable[..., None]) -> None:
    together = threading.Barrier(len(AWS.enabled), timeout=20)

    def connect(host: str, port: int, timeout: float) -> float:
        together.wait()
        return 0.1

    network(connect, ATTEMPTS=1, DEADLINE=30.0)
    found = AWS.measure(AWS.enabled)
    assert {one.milliseconds for one in found} == {100.0} and len(found) == len(AWS.enabled)


def test_geolocation_only_where_nobody_answers(network: Callable[..., None]) -> None:
    asked = []

    def locate() -> tuple[float, float]:
        asked.append(1)
        return 48.2, 16.4  # Vienna

    network(connector({'us-west-1': [0.1] * 3}), geolocate=locate)
    measured = AWS.ranked(['us-west-1', 'eu-central-1'])
    assert measured[0].region == 'us-west-1' and not asked
    network(connector({}))
    placed = AWS.ranked()
    assert placed[0] == Region('eu-central-1', 'Frankfurt', None, placed[0].distance_km)
    assert placed[0].distance_km == pytest.approx(600, abs=30) and asked


def test_table_without_any_answer_is_an_error(network: Callable[..., None]) -> None:
    def lost() -> tuple[float, float]:
        raise ProviderError('nobody knows')

    network(connector({}), geolocate=lost)
    with pytest.raises(ProviderError, match='none of 2 AWS regions answers; nobody knows'):
        AWS.ranked(['us-west-1', 'us-west-2'])
    network(connector({}), geolocate=lambda: (0.0, 0.0))
    with pytest.raises(ProviderError, match='xx-1'):
        AWS.ranked(['xx-1'])


def test_the_nearest_is_measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = []

    def ranked(names: tuple[str, ...], grace: float) -> list[Region]:
        measured.append(names)
        return [Region('eu-west-3', 'Paris', 12.0)]

    own = regions.Regions('AWS', REGIONS, HOST)
    monkeypatch.setattr(own, 'ranked', ranked)
    threads = [threading.Thread(target=own.nearest) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert own.nearest() == 'eu-west-3' and len(measured) == 1
    own.nearest(['us-west-1'])
    assert measured == [own.enabled, ('us-west-1',)]


def test_a_connection_is_timed_without_its_look_up(monkeypatch: pytest.MonkeyPatch) -> None:
    real = socket.getaddrinfo

    def slow(*words: object, **more: object) -> object:
        time.sleep(1.0)
        return real('127.0.0.1', port, type=socket.SOCK_STREAM)

    with socket.create_server(('127.0.0.1', 0)) as server:
        port = server.getsockname()[1]
        monkeypatch.setattr(socket, 'getaddrinfo', slow)
        assert regions.connect_time('ec2.nowhere.amazonaws.com', port, 20.0) < 0.9
    with pytest.raises(OSError):
        regions.connect_time('ec2.nowhere.amazonaws.com', port, 2.0)


def test_distances() -> None:
    assert regions.distance_km((0, 0), (0, 180)) == pytest.approx(math.pi * 6371)
    assert regions.distance_km((52.5, 13.4), (52.5, 13.4)) == 0
    # Berlin to New York
    assert regions.distance_km((52.52, 13.41), (40.71, -74.01)) == pytest.approx(6385, abs=10)


def test_geolocation_reads_what_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    import requests

    def answer(body: object) -> object:
        return SimpleNamespace(raise_for_status=lambda: None, json=lambda: body)

    monkeypatch.setattr(requests, 'get', lambda url, timeout: answer({'loc': '48.2085,16.3721'}))
    assert regions.geolocate() == (48.2085, 16.3721)
    for body in ({'loc': 'moon'}, {}, [], {'loc': '1,2,3'}):
        monkeypatch.setattr(requests, 'get', lambda url, timeout, body=body: answer(body))
        with pytest.raises(ProviderError, match='location of this computer'):
            regions.geolocate()

    def refuse(url: str, timeout: float) -> None:
        raise requests.ConnectionError('no route')

    monkeypatch.setattr(requests, 'get', refuse)
    with pytest.raises(ProviderError, match='does not answer either'):
        regions.geolocate()


def test_without_requests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__('sys').modules, 'requests', None)
    with pytest.raises(PrerequisiteError, match='requests'):
        regions.geolocate()


def test_botocore_knows_the_same_regions() -> None:
    import boto3
    if tuple(map(int, boto3.__version__.split('.')[:2])) < (1, 40):
        pytest.skip(f'boto3 {boto3.__version__} is older than the youngest regions')
    known = set(boto3.session.Session().get_available_regions('ec2'))
    assert set(REGIONS) <= known


@pytest.mark.parametrize(('named', 'refusing', 'answers'), [
    ('', ['north'], [['south']]), ('', ['north', 'south'], None),
    ('north south', ['north'], None)])
def test_region_that_the_account_must_not_use(
    monkeypatch: pytest.MonkeyPatch, named: str, refusing: list[str],
    answers: list[list[str]] | None,
) -> None:
    """It has no machine; but an account that may ask nowhere must not hear of no machines."""
    monkeypatch.setenv('FOGROS2_AWS_REGIONS', named)
    cloud = SimpleNamespace(searched_regions=lambda: ['north', 'south'])

    def ask(region: str) -> list[str]:
        if region in refusing:
            raise CloudError('this account may not list machines', denied=True)
        return [region]

    found = AWSProvider().everywhere(cloud, ask)  # type: ignore[arg-type]
    if answers is None:
        with pytest.raises(CloudError, match='may not list'):
            list(found)
    else:
        assert list(found) == answers
