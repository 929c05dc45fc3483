# SPDX-License-Identifier: Apache-2.0
"""Ask several clouds for offers at the same time, and compare the answers."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
import contextlib
import dataclasses
import functools
import threading
from typing import Optional

from fogros2 import plugin_system
from fogros2.errors import Cancelled, ConfigurationError, DeadlineExceeded, FogError, ProviderError
from fogros2.provider import Provider
from fogros2.provider.vm.options import NEAREST
from fogros2.provider.vm.provider import ALL, VmProvider
from fogros2.waiting import cancellable, wait_until
from fogros2_features.prices.market import seller
from fogros2_features.prices.offers import Offer, Offers, ranked, Seller, Wants

GROUP = 'fogros2.provider'
#: Seconds in which each cloud has to answer, for a few regions and for all.
DEADLINE, DEADLINE_ALL = 30.0, 120.0


def clouds() -> tuple[list[str], list[str]]:
    """Return the names of the providers with prices: those that are set up here, and the rest."""
    here: list[str] = []
    others: list[str] = []
    for name in plugin_system.names(GROUP):
        with contextlib.suppress(FogError):  # a plugin that cannot be loaded has no prices
            kind: type[Provider] = plugin_system.load(GROUP, name)
            if issubclass(kind, (VmProvider, Seller)):
                (here if kind.configured() else others).append(name)
    return here, others


def compare(
    wanted: Wants, names: Sequence[str] = (), regions: Sequence[str] = (), *,
    measure: bool = False, max_round_trip_ms: Optional[float] = None, refresh: bool = False,
    cancel: Optional[threading.Event] = None,
) -> Offers:
    """
    Return the offers of several clouds, the cheapest first.

    :param names: the providers; none for all that are set up here.
    :param regions: of any cloud, 'all' or 'nearest'; none for each cloud's configured region.
    :param measure: measure the round trip to each region.
    :param max_round_trip_ms: leave out regions that are further away; measures all regions.
    :returns: ``left_out`` names the clouds and regions that did not answer, or have no offer.
    :raises ConfigurationError: no cloud is set up here, or none of several has an offer.
    :raises FogError: the only cloud refused, or has no offer.
    """
    here, others = clouds()
    names = list(dict.fromkeys(names)) or here
    if not names:
        raise ConfigurationError('no cloud with prices is set up here',
                                 f"one of {', '.join(others)} needs credentials" if others else
                                 'pip list shows whether the plugin of one is installed')
    regions_of = {name: _own(name, regions) if len(names) > 1 else list(regions) for name in names}
    if regions and not any(regions_of.values()):
        raise ConfigurationError(f"none of {', '.join(names)} has a region {', '.join(regions)}",
                                 'ros2 fog regions --provider shows them')
    regions_of = {name: own for name, own in regions_of.items() if own or not regions}
    everywhere = ALL in regions or '*' in regions or max_round_trip_ms is not None
    deadline = DEADLINE_ALL if everywhere else DEADLINE
    late = threading.Event()
    with ThreadPoolExecutor(len(regions_of), 'fog-clouds') as pool:
        answers = {name: pool.submit(cancellable, functools.partial(
            _ask, name, wanted, own, refresh, measure, max_round_trip_ms, late), late,
            what=f'asking {name}', grace=lambda: 0.0) for name, own in regions_of.items()}
        try:
            with contextlib.suppress(DeadlineExceeded):
                wait_until(lambda: all(one.done() for one in answers.values()), timeout=deadline,
                           what='prices', cancel=cancel, longest=0.1)
        finally:
            late.set()
    candidates: list[Offer] = []
    where: list[str] = []
    left_out: list[tuple[str, str]] = []
    failed: list[FogError] = []
    for name, answer in answers.items():
        try:
            offers = answer.result()
        except FogError as error:
            failed.append(ProviderError(f'{name} does not answer within {deadline:g} s')
                          if isinstance(error, Cancelled) else error)
            left_out.append((name, str(failed[-1]).removeprefix(f'{name} ')))
        else:
            candidates += offers.offers
            where += offers.regions
            left_out += [(f'{name} {region}', why) for region, why in offers.left_out]
    priced = ranked(candidates, wanted.spot)
    if not priced and len(failed) == 1:
        raise failed[0]
    if not priced:
        raise ConfigurationError(
            f'no cloud offers {wanted}', '; '.join(map(': '.join, left_out)))
    return Offers(wanted, tuple(priced), tuple(dict.fromkeys(where)), tuple(left_out))


def _own(name: str, regions: Sequence[str]) -> list[str]:
    """Return the regions that a provider has."""
    kind: type[Provider] = plugin_system.load(GROUP, name)
    own = {*kind.region_names(), ALL, '*', NEAREST}
    return [region for region in regions if region in own]


def _ask(
    name: str, wanted: Wants, regions: Sequence[str], refresh: bool, measure: bool,
    limit: Optional[float], late: threading.Event,
) -> Offers:
    provider: Provider = plugin_system.load(GROUP, name)()
    provider.cancel = late
    times: dict[str, Optional[float]] = {}
    if limit is not None:
        times = _round_trips(provider, [r for r in regions if r not in (ALL, '*', NEAREST)])
        regions = [region for region, ms in times.items() if ms is not None and ms <= limit]
        if not regions:
            near = next((f'{region} takes {ms:.0f} ms' for region, ms in times.items() if ms),
                        'no region answers')
            raise ConfigurationError(f'{name} has no region within {limit:g} ms', near)
    result = seller(provider).offers(wanted, regions, refresh=refresh)
    if measure and not times:
        times = _round_trips(provider, result.regions)
    return dataclasses.replace(result, offers=tuple(dataclasses.replace(
        offer, provider=name, round_trip_ms=times.get(offer.region)) for offer in result.offers))


def _round_trips(provider: Provider, regions: Sequence[str]) -> dict[str, Optional[float]]:
    """Return the milliseconds to each region, the nearest first; none if no region answers."""
    with contextlib.suppress(FogError):
        return {one.region: one.milliseconds for one in provider.regions(regions)}
    return {}
