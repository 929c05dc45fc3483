# SPDX-License-Identifier: Apache-2.0
"""
Types and prices of a cloud's regions, cached on disk; choose the cheapest.

The entry point of the group ``fogros2.market`` is :class:`Market`: virtual machines of clouds get
by it their types and prices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import contextlib
import dataclasses
from decimal import Decimal
import hashlib
import json
from pathlib import Path
import threading
import time
from typing import Any, Optional, Union

from fogros2.errors import ConfigurationError, FogError, ProviderError, StoreError, Unsupported
from fogros2.model import MachineSpec, to_json
from fogros2.provider import Provider
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import PRICES_AGE, VmCloud
from fogros2.provider.vm.options import NEAREST, VmOptions
from fogros2.provider.vm.provider import ALL, VmProvider
from fogros2.store import state_home, write_private
from fogros2_features.prices.offers import fits, Offer, Offers, ranked, Seller, Wants, wants

#: Options with the same meaning in every cloud that do not choose the machine.
EVERYWHERE = ('disk_size', 'spot', 'tags', 'user', 'ssh_from', 'fleet')
#: Maximum number of types in one request for spot prices.
_NAMED_TYPES = 100


class Market:
    """
    Types and prices of each region; thread-safe.

    :param cache: folder of earlier answers, None for the one below the state folder.
    :param clock: seconds since the epoch.
    :param refresh: make new requests, whatever the cache has.
    """

    def __init__(
        self, source: VmCloud, *, cache: Optional[Path] = None,
        clock: Callable[[], float] = time.time, refresh: bool = False,
    ) -> None:
        self._source = source
        self._cache = cache
        self._clock = clock
        self._refresh = refresh
        self._known: dict[str, Any] = {}
        self._locks: dict[str, threading.Lock] = {}
        self._lock = threading.Lock()

    def types(self, region: str) -> list[MachineType]:
        """
        Return the current types of a region.

        :raises FogError: the cloud refused, or does not answer.
        """
        return list(self._kept(f'types-{region}', lambda: list(self._source.types(region))))

    def zones(self, region: str) -> dict[str, list[str]]:
        """Return the zones of a region that have each type."""
        return dict(self._kept(f'zones-{region}', lambda: self._source.zones(region)))

    def prices(self, region: str) -> dict[str, Decimal]:
        """Return the price of each type in US dollars per hour."""
        return dict(self._kept(f'prices-{region}', lambda: self._source.prices(region)))

    def price(self, region: str, name: str) -> Optional[Decimal]:
        """
        Return the price of one type in US dollars per hour, None if it is not sold.

        One request, unless the whole list is known.
        """
        listed: Optional[dict[str, Decimal]] = self._fresh(f'prices-{region}')
        if listed is None:
            listed = self._kept(f'price-{region}-{name}',
                                lambda: self._source.prices(region, name))
        return listed.get(name)

    def spot(
        self, region: str, names: Optional[Sequence[str]] = None,
    ) -> dict[str, dict[str, Decimal]]:
        """
        Return the current spot price of each type by zone, in US dollars per hour.

        :param names: these types only; None for all.
        """
        named = sorted(names) if names is not None and len(names) <= _NAMED_TYPES else None
        key = f'spot-{region}'
        if named is not None and self._fresh(key) is None:
            key += '-' + hashlib.sha256(' '.join(named).encode()).hexdigest()[:12]
        prices = self._kept(key, lambda: self._source.spot_prices(region, named))
        return {name: zones for name, zones in prices.items() if names is None or name in names}

    def price_of(self, region: str, name: str, *, spot: bool = False) -> Decimal:
        """
        Return the price of a type in US dollars per hour; a spot type in its cheapest zone.

        :raises ProviderError: the region does not sell it.
        """
        price = cheapest_zone(zones := self.spot(region, [name]).get(name, {}), zones) if spot \
            else self.price(region, name)
        if price is None:
            raise ProviderError(
                f"{self._source.title} has no {'spot ' if spot else ''}price of {name} in "
                f'{region}', 'ros2 fog price --region shows the types that a region has')
        return price

    def cost_of(self, region: str, name: str, options: VmOptions) -> Decimal:
        """
        Return the price that counts for a machine's cost, in US dollars per hour.

        For a spot machine it is that of the dearest zone within ``max_price``, because the cloud
        chooses the zone.

        :raises ProviderError: the region does not sell it.
        """
        price, limit = self.price_of(region, name, spot=options.spot), options.max_price
        zones = self.spot(region, [name])[name].values() if options.spot else ()
        return max((zone for zone in zones if limit is None or zone <= limit), default=price)

    def check(self, region: str, name: str, options: VmOptions) -> None:
        """
        Check that a type costs at most ``max_price``.

        :raises ConfigurationError: it costs more.
        """
        price = self.price_of(region, name, spot=options.spot)
        if options.max_price is not None and price > options.max_price:
            raise ConfigurationError(
                f'{name} in {region} costs {price} US dollars an hour, more than max_price='
                f'{options.max_price}', 'ros2 fog price shows what is cheaper')

    # -- choosing -------------------------------------------------------------------------

    def kinds(self, region: str, options: VmOptions) -> list[str]:
        """
        Return the types that meet the requirements of a machine, the cheapest first.

        :raises FogError: as :meth:`choose` does.
        """
        wanted = wants(
            arch=options.arch or None, min_cpu=int(options.min_cpu) or None,
            min_memory_gb=options.min_memory_gb or None, cpu_type=options.cpu_type or None,
            gpu=options.gpu or None, gpu_memory_gb=options.gpu_memory_gb or None,
            max_price=options.max_price, spot=options.spot)
        return [offer.type.name for offer in self.choose([region], wanted).offers]

    def offers(self, region: str, wanted: Wants, *, spot_too: bool = False) -> list[Offer]:
        """
        Return the types of one region that meet the requirements, the cheapest first.

        :param spot_too: look up spot prices even if prices on demand are compared.
        :raises FogError: the cloud refused, or does not answer.
        """
        with ThreadPoolExecutor(3, f'fog-{region}') as pool:  # about ten pages each
            asking = (pool.submit(self.zones, region), pool.submit(self.types, region),
                      pool.submit(self.prices, region))
            zones, types, prices = (asking[0].result(), asking[1].result(), asking[2].result())
        kinds = [kind for kind in types if fits(kind, wanted) and kind.name in zones]
        if not kinds:
            return []
        spot = self.spot(region, [kind.name for kind in kinds]) if wanted.spot or spot_too else {}
        return ranked([
            Offer(region, kind, prices.get(kind.name),
                  cheapest_zone(spot.get(kind.name, {}), zones[kind.name]),
                  tuple(zones[kind.name])) for kind in kinds], wanted.spot)

    def choose(self, regions: Sequence[str], wanted: Wants, *, spot_too: bool = False) -> Offers:
        """
        Return the types of several regions that meet the requirements, the cheapest first.

        All regions are asked at the same time; the result names those that cannot be asked.

        :raises ConfigurationError: nothing fits, or everything costs more than ``max_price``.
        :raises FogError: no region could be asked.
        """
        offers: list[Offer] = []
        failed: list[tuple[str, FogError]] = []

        def ask(region: str) -> Union[list[Offer], FogError]:
            try:
                return self.offers(region, wanted, spot_too=spot_too)
            except FogError as error:
                return error

        with ThreadPoolExecutor(min(16, max(1, len(regions))), 'fog-prices') as pool:
            for region, answer in zip(regions, pool.map(ask, regions)):
                if isinstance(answer, FogError):
                    failed.append((region, answer))
                else:
                    offers += answer
        if failed and len(failed) == len(regions):
            raise failed[0][1]
        where = regions[0] if len(regions) == 1 else f'{len(regions)} regions'
        if not offers:
            gpus = {kind.gpu for region in regions
                    for kind in self._fresh(f'types-{region}') or ()}
            raise ConfigurationError(
                f'no {self._source.title} type in {where} has {wanted}',
                f"GPUs there: {', '.join(sorted(filter(None, gpus))) or 'none'}" if wanted.gpu else
                'ask for less, or in another region')
        offers = ranked(offers, wanted.spot)
        cheapest = offers[0]
        if wanted.max_price is not None:
            offers = [o for o in offers if (o.cost(wanted.spot) or Decimal(0)) <= wanted.max_price]
        if not offers:
            raise ConfigurationError(
                f'nothing in {where} with {wanted} costs at most ${wanted.max_price} an hour',
                f'the cheapest is {cheapest.type.name} in {cheapest.region} for '
                f'${cheapest.cost(wanted.spot)}')
        return Offers(wanted, tuple(offers), tuple(regions),
                      tuple((region, str(error)) for region, error in failed))

    # -- cache ----------------------------------------------------------------------------

    def _kept(self, key: str, ask: Callable[[], Any]) -> Any:
        """Return a cached answer, or make the request, in one thread at a time."""
        with self._lock:
            lock = self._locks.setdefault(key, threading.Lock())
        with lock:
            answer = self._fresh(key)
            if answer is None:
                answer = self._known[key] = ask()
                with contextlib.suppress(StoreError):  # the next launch takes longer
                    write_private(self._path(key), to_json({
                        'source': self._source.account_key(), 'time': self._clock(),
                        'value': answer}).encode())
            return answer

    def _fresh(self, key: str) -> Any:
        """Return an answer that is not too old, None if there is none."""
        kind = key.partition('-')[0]
        if key not in self._known and not self._refresh:
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError,
                                     ArithmeticError):  # missing or damaged
                data = json.loads(self._path(key).read_text())
                if data['source'] == self._source.account_key() \
                        and 0 <= self._clock() - float(data['time']) < self._age(kind):
                    self._known[key] = _READ[kind](data['value'])
        return self._known.get(key)

    def _age(self, kind: str) -> float:
        return self._source.types_age if kind in ('types', 'zones') else PRICES_AGE

    def _path(self, key: str) -> Path:
        return (self._cache or state_home() / 'cache' / self._source.name) / f'{key}.json'


def _prices(value: Any) -> dict[str, Decimal]:
    return {name: Decimal(price) for name, price in value.items()}


#: Convert the answers in files, by the first word of their keys; an error shows damage.
_READ: Mapping[str, Callable[[Any], Any]] = {
    'types': lambda value: [MachineType(**entry) for entry in value],
    'zones': lambda value: {name: list(map(str, zones)) for name, zones in value.items()},
    'spot': lambda value: {name: _prices(zones) for name, zones in value.items()},
    'prices': _prices, 'price': _prices}


def cheapest_zone(zones: Mapping[str, Decimal], among: Iterable[str]) -> Optional[Decimal]:
    """Return the lowest price in some zones, None if there is none."""
    return min((zones[zone] for zone in among if zone in zones), default=None)


class CloudSeller:
    """The seller for a cloud of virtual machines."""

    def __init__(self, provider: VmProvider) -> None:
        self._provider = provider

    def offers(
        self, wanted: Wants, regions: Sequence[str] = (), *, refresh: bool = False,
    ) -> Offers:
        """Return the offers of the cloud's regions."""
        cloud = self._provider.cloud.until(self._provider.cancel)
        # checked first: a measurement takes seconds, and is useless without credentials
        cloud.check_credentials()
        names = [name for name in regions if name]
        if not names:
            names = [cloud.default_region() or NEAREST]
        if {ALL, '*'} & set(names):
            names = cloud.enabled_regions()
        named = list(dict.fromkeys(
            self._provider.nearest() if name == NEAREST else name for name in names))
        return Market(cloud, refresh=refresh).choose(named, wanted, spot_too=True)

    def taking(self, spec: MachineSpec, offer: Offer) -> MachineSpec:
        """Return the spec with the options that all clouds have."""
        kept = {name: spec.options[name] for name in EVERYWHERE if name in spec.options}
        kind = self._provider.cloud.options.TYPE
        return dataclasses.replace(
            spec, provider=self._provider.name, wanted=spec.options,
            options={**kept, 'region': offer.region, kind: offer.type.name})


def seller(provider: Provider) -> Seller:
    """
    Return what lists the types of a provider with prices.

    :raises Unsupported: the provider has no price list.
    """
    if isinstance(provider, VmProvider):
        return CloudSeller(provider)
    if isinstance(provider, Seller):
        return provider
    raise Unsupported(f"provider '{provider.name}' has no price list")
