# SPDX-License-Identifier: Apache-2.0
"""Prices of several clouds in one table, and the machine that takes the cheapest of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import dataclasses
from decimal import Decimal
import json
from pathlib import Path
import threading
from typing import Any, Optional

import pytest
from ros2cli.cli import main

from fogros2.deploy import Launch
from fogros2.deploy import launch as launches
from fogros2.deploy.running import RunningMachine
from fogros2.deploy.steps.creating import Creation
from fogros2.errors import ConfigurationError, FogError, NameTaken, ProviderError
from fogros2.model import Machine, MachineSpec, MachineState
from fogros2.provider.azure.provider import AzureProvider
from fogros2.provider.gcp import prices
from fogros2.provider.gcp.provider import GCPProvider
from fogros2.provider.machine_types import MachineType, Region
from fogros2.provider.vm import regions
from fogros2.report import Warned
from fogros2.store import Record, Store
from fogros2_features.prices import clouds
from fogros2_features.prices.market import seller
from fogros2_features.prices.offers import Offer, Offers, ranked, Wants, wants
from fogros2_features.prices.provider import Cheapest
from fogros2_testing.fakes import FakeProvider, FakeVpn
from fogros2_testing.plugins import instead
from rigs.gce.catalogue import API_KEY


def run(*words: str) -> Any:
    return main(argv=['fog', 'price', *words])


class Fake(FakeProvider):
    """A cloud with two regions and one size."""

    place = 'north'
    price = Decimal(1)
    size = MachineType('small', 8, 4, 32.0, 'x86_64', 'AMD', 1, 'NVIDIA L4', 22.4)
    capabilities = FakeProvider.can(regions=True)
    times: dict[str, float] = {}
    here = True
    closed: Sequence[str] = ()

    @classmethod
    def configured(cls) -> bool:
        return cls.here

    @classmethod
    def region_names(cls) -> Sequence[str]:
        return [cls.place, f'{cls.place}-2']

    def regions(self, names: Sequence[str] = (), *, every: bool = False) -> list[Region]:
        found = [Region(name, '', self.times.get(name))
                 for name in names or self.region_names()]
        return sorted(found, key=lambda one: one.milliseconds or 1e9)

    def offers(
        self, wanted: Wants, regions: Sequence[str] = (), *, refresh: bool = False,
    ) -> Offers:
        self._called('offers')
        named = list(regions) or [self.place]
        named = list(self.region_names()) if 'all' in named else named
        found = [Offer(name, self.size, self.price * (number + 1))
                 for number, name in enumerate(named) if name not in self.closed]
        return Offers(wanted, tuple(ranked(found, wanted.spot)), tuple(named), tuple(
            (name, 'not enabled') for name in named if name in self.closed))

    def taking(self, spec: MachineSpec, offer: Offer) -> MachineSpec:
        return dataclasses.replace(
            spec, provider=self.name, wanted=spec.options, options={'size': offer.region})


class North(Fake):
    name = 'north'


class South(Fake):
    name, place, price = 'south', 'south', Decimal('1.5')


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> dict[str, Fake]:
    """Install two clouds, one object each; the first is the cheaper one."""
    made: dict[str, Fake] = {'north': North(), 'south': South()}

    def maker(kind: type[Fake]) -> type[Fake]:
        # the class's methods are asked before there is an object
        return type(kind.name, (kind,), {'__new__': lambda cls: made[kind.name]})

    monkeypatch.setattr(Fake, 'times', {'north': 30.0, 'north-2': 80.0, 'south': 12.34})
    instead(monkeypatch, 'fogros2.provider', {
        'cheapest': Cheapest, 'north': maker(North), 'south': maker(South)})
    return made


@pytest.fixture
def two_clouds(
    gce: Any, azure_service: Any, monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Callable[..., None]]:
    """Use Google's and Azure's simulated services, with prices and connect times."""
    prices._asked.cache_clear()
    monkeypatch.setenv(prices.KEY_VARIABLE, API_KEY)
    monkeypatch.setenv(prices.ENDPOINT_VARIABLE, f'{gce.url}/')
    monkeypatch.setenv('CLOUDSDK_COMPUTE_REGION', 'europe-west3')
    monkeypatch.setattr(clouds, 'DEADLINE', 300.0)  # a busy computer loads libraries slowly
    monkeypatch.setattr(clouds, 'DEADLINE_ALL', 300.0)
    monkeypatch.setattr(regions, 'connect_time', lambda host, port, timeout: (
        0.0123 if 'europe-west3' in host else 0.0456))
    instead(monkeypatch, 'fogros2.provider', {'azure': AzureProvider, 'gcp': GCPProvider})
    yield monkeypatch.setenv
    prices._asked.cache_clear()


# -- the table --------------------------------------------------------------------------------


def test_one_table_has_the_prices_of_all_clouds(
    two_clouds: Any, capsys: pytest.CaptureFixture[str],
) -> None:
    assert run('--arch', 'x86_64', '--limit', '3') == 0
    said = capsys.readouterr()
    assert said.out.splitlines() == [
        '2 CPUs, 4 GB, x86_64, in westeurope, europe-west3',
        'TYPE               PROVIDER  REGION        CPUS  MEMORY  ARCH    CPU    PRICE/H  SPOT/H '
        '  ROUND TRIP',
        'Standard_B2als_v2  azure     westeurope    2     4 GB    x86_64  AMD    $0.0376  $0.0094'
        '  46 ms',
        'e2-medium          gcp       europe-west3  2     4 GB    x86_64  -      $0.0432  $0.0086'
        '  12 ms',
        'Standard_D2s_v5    azure     westeurope    2     8 GB    x86_64  Intel  $0.0960  $0.0192'
        '  46 ms',
        '9 more cost as much or more (--limit 0)']
    assert said.err == ''
    assert run('--arch', 'x86_64', '--spot', '--limit', '2', '--json') == 0
    offers = json.loads(capsys.readouterr().out)['offers']
    assert [(one['provider'], one['type'], one['spot_price'], round(one['round_trip_ms'], 1))
            for one in offers] == [('gcp', 'e2-medium', 0.0086319, 12.3),
                                   ('azure', 'Standard_B2als_v2', 0.0094, 45.6)]


def test_one_l4_is_found_in_the_cloud_that_has_it(
    two_clouds: Any, capsys: pytest.CaptureFixture[str],
) -> None:
    assert run('--min-cpu', '8', '--min-memory', '32', '--gpu', 'L4', '--arch', 'x86_64',
               '--provider', 'all') == 0
    said = capsys.readouterr()
    (line,) = said.out.splitlines()[2:]
    # 8 vCPUs, 32 GB, one L4
    assert line.split()[:3] == ['g2-standard-8', 'gcp', 'europe-west3']
    assert '1 x NVIDIA L4 22.4 GB' in line and '$1.0982' in line
    assert '12 ms' in line and 'azure: no Azure type in westeurope has 8 CPUs, 32 GB' in said.err
    asked = {'arch': 'x86_64', 'min_cpu': 8, 'min_memory_gb': 32, 'gpu': 'L4',
             'max_round_trip_ms': 20.0}
    ((offer, place),) = Cheapest().places(MachineSpec('planner', 'cheapest', asked))
    assert (offer, place.provider) == ('g2-standard-8 of gcp in europe-west3', 'gcp')


def test_cloud_that_is_not_set_up_is_named_and_not_asked(
    fakes: dict[str, Fake], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(South, 'here', False)
    assert run() == 0
    said = capsys.readouterr()
    assert said.err == 'not set up here: south\n'
    assert fakes['south'].calls == [] and said.out.splitlines()[2].split()[:3] == [
        'small', 'north', 'north']
    monkeypatch.setattr(North, 'here', False)
    assert 'no cloud with prices is set up here (one of north, south needs credentials)' in str(
        run())
    # named, it is asked
    assert run('--provider', 'south') == 0
    assert capsys.readouterr().err == ''


def test_table_is_printed_without_a_silent_cloud(
    fakes: dict[str, Fake], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    end = threading.Event()
    monkeypatch.setattr(clouds, 'DEADLINE', 2.0)
    monkeypatch.setattr(South, 'offers', lambda *_, **__: end.wait(60.0))
    assert run() == 0
    end.set()
    said = capsys.readouterr()
    assert 'small' in said.out and said.err == 'south: does not answer within 2 s\n'


def test_refusing_cloud_is_a_line_below_the_table(
    fakes: dict[str, Fake], capsys: pytest.CaptureFixture[str],
) -> None:
    fakes['north'].failures['offers'] = ProviderError('the token has expired', 'log in')
    assert run() == 0
    said = capsys.readouterr()
    assert 'south' in said.out and said.err == 'north: the token has expired (log in)\n'
    fakes['north'].closed = ['north-2']
    assert run('--region', 'all', '--limit', '1') == 0
    said = capsys.readouterr()
    assert said.out.splitlines()[2].split()[:3] == ['small', 'north', 'north']
    assert said.out.endswith('2 more cost as much or more (--limit 0)\n')
    assert said.err == 'north north-2: not enabled\n'
    for fake in fakes.values():
        fake.failures['offers'] = ProviderError(f'no {fake.name}')
    assert 'no cloud offers 2 CPUs, 4 GB' in str(error := run()) and 'no north' in str(error)


def test_bad_input_is_named(two_clouds: Any) -> None:
    for words, expected in (
            ('--gpu L5', 'no Azure type in westeurope has 2 CPUs, 4 GB, 1 GPU L5, x86_64 '
             '(GPUs there: NVIDIA T4)'),
            ('--gpu L5', 'no Google Cloud type in europe-west3 has'),
            ('--min-cpu 512', '(ask for less, or in another region)'),
            ('--max-price 0.001', 'costs at most $0.001 an hour (the cheapest is'),
            ('--max-price cheap', "'cheap' is no price"),
            ('--max-round-trip 5', 'azure: has no region within 5 ms'),
            ('--region moon-1', 'none of azure, gcp has a region moon-1')):
        assert expected in str(run('--arch', 'x86_64', *words.split())), words


def test_unknown_provider_is_named() -> None:
    assert "there is no provider 'acme'" in str(run('--provider', 'acme'))


def test_regions_belong_to_their_clouds(fakes: dict[str, Fake]) -> None:
    found = clouds.compare(wants(arch='x86_64'), (), ['south-2', 'north'])
    assert [str(offer) for offer in found.offers] == [
        'small of north in north', 'small of south in south-2']
    assert fakes['north'].calls == ['offers']


def test_regions_that_are_too_far_are_left_out(fakes: dict[str, Fake]) -> None:
    found = clouds.compare(wants(), max_round_trip_ms=50.0)
    assert [(offer.region, offer.round_trip_ms) for offer in found.offers] == [
        ('north', 30.0), ('south', 12.34)]
    with pytest.raises(ConfigurationError, match=r'within 5 ms \(north takes 30 ms\)'):
        clouds.compare(wants(), ['north'], max_round_trip_ms=5.0)


# -- a machine of the cheapest cloud ----------------------------------------------------------


def test_cheapest_tries_each_cloud_and_the_cheapest_first(
    fakes: dict[str, Fake], monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('fogros2_features.prices.provider.TRIES', 2)
    spec = MachineSpec('planner', 'cheapest', {'min_cpu': 8, 'gpu': 'L4'})
    found = Cheapest().places(spec)
    assert [offer for offer, _ in found] == [
        'small of north in north', 'small of south in south']
    assert [(place.provider, place.options, place.wanted) for _, place in found] == [
        ('north', {'size': 'north'}, spec.options), ('south', {'size': 'south'}, spec.options)]
    for options, words in (({'max_round_trip_ms': 0}, 'max_round_trip_ms can not be 0'),
                           ({'min_cpu': -1}, 'min_cpu can not be -1')):
        with pytest.raises(ConfigurationError, match=words):
            Cheapest().check(dataclasses.replace(spec, options=options))


def test_offer_of_a_cloud_becomes_its_options() -> None:
    spec = MachineSpec('planner', 'cheapest', {'min_cpu': 2, 'disk_size': 40, 'spot': True})
    taken = seller(AzureProvider()).taking(spec, Offer(
        'westeurope', MachineType('Standard_D2s_v5', 2, 1, 8.0, 'x86_64')))
    assert (taken.provider, taken.options) == ('azure', {
        'region': 'westeurope', 'vm_size': 'Standard_D2s_v5', 'disk_size': 40, 'spot': True})


@pytest.fixture
def launch(
    fakes: dict[str, Fake], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> Callable[[list[Any]], Launch]:
    monkeypatch.setattr(launches, 'check_robot', lambda: None)
    instead(monkeypatch, 'fogros2.vpn', {'wireguard': FakeVpn})
    monkeypatch.setattr('fogros2.shell.warm', lambda kind: None)
    return lambda events: Launch(store=Store(tmp_path), environment={}, report=events.append)


SPEC = MachineSpec('planner', 'cheapest', {'min_cpu': 8, 'regions': ['north', 'south']})


@pytest.mark.parametrize(('full', 'tried'), [(True, ['north', 'south']), (False, ['north'])])
def test_only_a_lack_of_capacity_tries_the_next_cloud(
    fakes: dict[str, Fake], launch: Any, monkeypatch: pytest.MonkeyPatch, full: bool,
    tried: list[str],
) -> None:
    events: list[Any] = []
    made: list[tuple[str, str]] = []
    error = ProviderError('no machine is free')
    error.no_capacity = full

    def bring_up(context: Any, place: MachineSpec) -> str:
        made.append((place.provider, place.options['size']))
        if place.provider == 'north':
            raise error
        return 'up'

    monkeypatch.setattr(launches, 'bring_up', bring_up)
    monkeypatch.setattr(Launch, 'context', lambda self, spec: None)
    mine = launch(events)
    mine.prepare([SPEC])
    assert made == []
    if full:
        assert mine._bring_up(SPEC) == 'up'
    else:
        with pytest.raises(FogError, match='no machine is free'):
            mine._bring_up(SPEC)
    assert [provider for provider, _ in made] == tried
    assert [one for one in events if isinstance(one, Warned)] == [Warned(
        'planner', "'planner': no machine is free",
        'the launch tries the next offer, of south')] * full
    # asked once for the launch
    assert fakes['north'].calls.count('offers') == 1


@pytest.fixture
def kept(fakes: dict[str, Fake], tmp_path: Path) -> MachineSpec:
    """Keep a machine in the dearer cloud; return its spec."""
    place = dataclasses.replace(
        SPEC, provider='south', options={'size': 'south'}, wanted=SPEC.options)
    Store(tmp_path).save(Record('planner', 'south', place, machine_id='m', asked=place.options))
    fakes['south'].machines['m'] = Machine('m', 'planner', 'south', MachineState.RUNNING)
    return place


def test_kept_machine_stays_in_its_cloud(
    fakes: dict[str, Fake], launch: Any, kept: MachineSpec,
) -> None:
    mine = launch([])
    assert mine._places(SPEC) == [kept] and fakes['north'].calls == []
    other = dataclasses.replace(SPEC, options={'min_cpu': 4})
    assert mine._places(other)[0].provider == 'north'


def create(launch: Launch, place: MachineSpec) -> RunningMachine:
    context = launch.context(place)
    machine = RunningMachine(context, place)
    Creation(context, machine).run()
    return machine


@pytest.mark.parametrize('expired', [None, MachineState.DELETED])
def test_expired_machine_leaves_its_name_to_the_cheapest(
    fakes: dict[str, Fake], launch: Any, kept: MachineSpec, expired: Optional[MachineState],
) -> None:
    if expired is None:
        del fakes['south'].machines['m']
    else:
        fakes['south'].machines['m'] = Machine('m', 'planner', 'south', expired)
    mine = launch([])
    mine.prepare([SPEC])
    assert [cost.spec.provider for cost in mine.costs()] == ['north']
    machine = create(mine, mine._places(SPEC)[0])
    assert mine.store.load('planner').provider == 'north'
    assert [*fakes['north'].machines] == [machine.machine_id] and not fakes['south'].machines


def test_machine_of_another_cloud_keeps_its_name(
    fakes: dict[str, Fake], launch: Any, kept: MachineSpec,
) -> None:
    with pytest.raises(NameTaken, match="'planner' is a machine of the provider 'south'"):
        create(launch([]), dataclasses.replace(kept, provider='north', wanted=None))
    assert fakes['north'].machines == {} and [*fakes['south'].machines] == ['m']


def test_replacement_takes_the_offer_that_is_cheapest_then(
    fakes: dict[str, Fake], launch: Any,
) -> None:
    mine = launch([])
    mine.prepare([SPEC])
    fakes['north'].price = Decimal(9)
    assert mine._places(SPEC)[0].provider == 'north'
    mine.retire('planner')
    assert mine._places(SPEC)[0].provider == 'south'
