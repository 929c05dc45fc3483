# SPDX-License-Identifier: Apache-2.0
"""Choosing where and on what to run: the nearest region, the cheapest type that fits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
import dataclasses
from decimal import Decimal
import platform
import re
from typing import Optional, Union

from fogros2.errors import ConfigurationError, FogError, ProviderError
from fogros2.provider.aws import regions as places
from fogros2.provider.aws.clients import Account, usual
from fogros2.provider.aws.prices import cheapest_zone, InstanceType, Market

#: What 'cheapest' means where nothing else is said: as much as the default type t3.medium has.
MIN_CPU = 2
MIN_MEMORY_GB = 4.0
_ARCHITECTURES = {
    'x86_64': 'x86_64', 'amd64': 'x86_64', 'arm64': 'arm64', 'aarch64': 'arm64', 'any': ''}
#: Whose GPUs run CUDA, which is meant where only a number of them is asked for.
_CUDA = 'nvidia'


@dataclasses.dataclass(frozen=True)
class Wants:
    """
    What a machine has to have at the least.

    :param arch: ``x86_64`` or ``arm64``; '' for either.
    :param min_cpu: hardware threads (vCPUs).
    :param min_memory_gb: GiB.
    :param cpu_type: maker of the processor: intel, amd, aws; '' for any.
    :param gpus: how many.
    :param gpu: word of the GPU's maker or name, such as 'L4'; '' for NVIDIA.
    :param gpu_memory_gb: GB of each GPU.
    :param max_price: US dollars an hour; None for no limit.
    :param spot: whether the spot price counts.
    :param cores: exactly as many physical cores, as FogROS2 asks; None for any.
    :param threads_per_core: exactly as many, as FogROS2 asks; None for any.
    """

    arch: str = ''
    min_cpu: int = MIN_CPU
    min_memory_gb: float = MIN_MEMORY_GB
    cpu_type: str = ''
    gpus: int = 0
    gpu: str = ''
    gpu_memory_gb: float = 0.0
    max_price: Optional[Decimal] = None
    spot: bool = False
    cores: Optional[int] = None
    threads_per_core: Optional[int] = None

    def __str__(self) -> str:
        words = [f'{self.min_cpu} CPUs', f'{self.min_memory_gb:g} GB']
        if self.gpus:
            words.append(f"{self.gpus} GPU{'s' if self.gpus > 1 else ''}"
                         + (f' {self.gpu}' if self.gpu else '')
                         + (f' of {self.gpu_memory_gb:g} GB' if self.gpu_memory_gb else ''))
        words += [word for word in (self.arch, self.cpu_type) if word]
        if self.cores is not None:
            words.append(f'exactly {self.cores} cores')
        if self.threads_per_core is not None:
            words.append(f"{self.threads_per_core} thread{'s' * (self.threads_per_core > 1)}"
                         ' a core')
        if self.spot:
            words.append('spot')
        return ', '.join(words)


@dataclasses.dataclass(frozen=True)
class Offer:
    """
    A type in a region, and its price.

    :param price: US dollars an hour, ``spot_price`` in its cheapest zone now; None where it can't
        be had so.
    :param zones: where the region has it.
    """

    region: str
    type: InstanceType
    price: Optional[Decimal] = None
    spot_price: Optional[Decimal] = None
    zones: tuple[str, ...] = ()

    def cost(self, spot: bool) -> Optional[Decimal]:
        """Return the price that counts."""
        return self.spot_price if spot else self.price


@dataclasses.dataclass(frozen=True)
class Choice:
    """
    The offers that fit, the cheapest first, which is the one that was chosen.

    :param wants: what was asked for.
    :param left_out: regions that couldn't be asked, each with the reason.
    """

    wants: Wants
    offers: tuple[Offer, ...]
    left_out: tuple[tuple[str, str], ...] = ()

    @property
    def chosen(self) -> Offer:
        """The cheapest."""
        return self.offers[0]


def wants(
    *, arch: Optional[str] = None, min_cpu: Optional[int] = None,
    min_memory_gb: Optional[float] = None, cpu_type: Optional[str] = None,
    gpu: Union[bool, int, str, None] = None, gpu_memory_gb: Optional[float] = None,
    max_price: Union[Decimal, str, float, None] = None, spot: bool = False,
    cores: Optional[int] = None, threads_per_core: Optional[int] = None,
) -> Wants:
    """
    Return what a launch file or a command line asks for, as it says it.

    :param arch: None for this computer's own, so that a workspace runs there as it is.
    :param gpu: a number, True for one, or part of the name of one.
    :raises ConfigurationError: something makes no sense.
    """
    named = gpu if isinstance(gpu, str) and not gpu.isdigit() else ''
    number = 1 if named or gpu is True else int(gpu or 0)
    if gpu_memory_gb and not number:
        number = 1
    given = platform.machine() if arch is None else arch
    if given.lower() not in _ARCHITECTURES:
        raise ConfigurationError(f"no EC2 machine has the architecture '{given}'",
                                 'there are x86_64, arm64 and any')
    for name, value in (('min_cpu', min_cpu), ('min_memory_gb', min_memory_gb), ('gpu', number),
                        ('gpu_memory_gb', gpu_memory_gb), ('cores', cores),
                        ('threads_per_core', threads_per_core)):
        if value is not None and not 0 <= value < 1_000_000:
            raise ConfigurationError(f'{name} can not be {value:g}',
                                     'it takes a number from 0 to a million')
    return Wants(
        _ARCHITECTURES[given.lower()], MIN_CPU if min_cpu is None else int(min_cpu),
        MIN_MEMORY_GB if min_memory_gb is None else float(min_memory_gb), cpu_type or '', number,
        named, float(gpu_memory_gb or 0), dollars(max_price), spot, cores, threads_per_core)


def dollars(value: Union[Decimal, str, float, None]) -> Optional[Decimal]:
    """
    Return a price as a number to compare, None for none.

    :raises ConfigurationError: it is no number above 0.
    """
    if value is None:
        return None
    try:
        price = Decimal(str(value).removeprefix('$'))
    except ArithmeticError:
        price = Decimal(0)
    if not price.is_finite() or price <= 0:
        raise ConfigurationError(f"'{value}' is no price", 'give US dollars an hour, such as 0.5')
    return price


def fits(kind: InstanceType, asked: Wants) -> bool:
    """Return whether a type has what is asked for; its price aside."""
    return ((not asked.arch or kind.arch == asked.arch)
            and kind.vcpus >= asked.min_cpu
            and kind.memory_gb >= asked.min_memory_gb
            and asked.cpu_type.lower() in kind.cpu.lower()
            and (not asked.spot or kind.spot)
            and (not asked.gpus or kind.gpus >= asked.gpus and _is_gpu(kind, asked))
            and (asked.cores is None or kind.cores == asked.cores)
            and (asked.threads_per_core is None
                 or kind.vcpus == asked.threads_per_core * kind.cores))


def _is_gpu(kind: InstanceType, asked: Wants) -> bool:
    # AWS tells GiB, everybody else says GB: a card of '24 GB' has 22.4 GiB
    gigabytes = kind.gpu_memory_gb * 1.024 ** 3 + 0.1
    named = re.search(rf'\b{re.escape(asked.gpu or _CUDA)}\b', kind.gpu, re.IGNORECASE)
    return named is not None and gigabytes >= asked.gpu_memory_gb


def offers(
    region: str, asked: Wants, market: Market, *, spot_too: bool = False,
) -> list[Offer]:
    """
    Return what fits in one region, the cheapest first, whatever its price.

    :param spot_too: look for the spot prices even where they don't count.
    :raises FogError: AWS refused, or can't be reached.
    """
    with ThreadPoolExecutor(3, f'fog-{region}') as pool:  # some ten pages each, one by one
        asking = (pool.submit(market.zones, region), pool.submit(market.types, region),
                  pool.submit(market.prices, region))
        zones, types, prices = (asking[0].result(), asking[1].result(), asking[2].result())
    kinds = [kind for kind in types if fits(kind, asked) and kind.name in zones]
    if not kinds:
        return []
    spot = market.spot(region, [kind.name for kind in kinds]) if asked.spot or spot_too else {}
    found = [Offer(region, kind, prices.get(kind.name),
                   cheapest_zone(spot.get(kind.name, {}), zones[kind.name]),
                   tuple(zones[kind.name])) for kind in kinds]
    return ranked(found, asked)


def ranked(found: Iterable[Offer], asked: Wants) -> list[Offer]:
    """Return the offers that have a price, the lowest first; of two at one the larger."""
    priced = [(cost, offer) for offer in found
              if (cost := offer.cost(asked.spot)) is not None]
    return [offer for _, offer in sorted(priced, key=lambda pair: (
        pair[0], -pair[1].type.vcpus, -pair[1].type.memory_gb, pair[1].type.name,
        pair[1].region))]


def choose(
    regions: Sequence[str], asked: Wants, market: Optional[Market] = None, *,
    spot_too: bool = False,
) -> Choice:
    """
    Return what fits in some regions, the cheapest of all first.

    All regions are asked at once; one that can't be is left out, and named in the answer.

    :raises ConfigurationError: nothing there is fits, or it costs more than ``max_price``.
    :raises FogError: no region could be asked.
    """
    market = market or Market()
    found: list[Offer] = []
    failed: list[tuple[str, FogError]] = []

    def ask(region: str) -> Union[list[Offer], FogError]:
        try:
            return offers(region, asked, market, spot_too=spot_too)
        except FogError as error:
            return error

    with ThreadPoolExecutor(min(16, max(1, len(regions))), 'fog-prices') as pool:
        for region, answer in zip(regions, pool.map(ask, regions)):
            if isinstance(answer, FogError):
                failed.append((region, answer))
            else:
                found += answer
    if failed and len(failed) == len(regions):
        raise failed[0][1]
    where = regions[0] if len(regions) == 1 else f'{len(regions)} regions'
    if not found:
        raise ConfigurationError(f'no EC2 type in {where} has {asked}',
                                 'ask for less, or in another region')
    found = ranked(found, asked)
    cheapest = found[0]
    if asked.max_price is not None:
        found = [o for o in found if (o.cost(asked.spot) or Decimal(0)) <= asked.max_price]
    if not found:
        raise ConfigurationError(
            f'nothing in {where} with {asked} costs at most ${asked.max_price} an hour',
            f'the cheapest is {cheapest.type.name} in {cheapest.region} for '
            f'${cheapest.cost(asked.spot)}')
    return Choice(asked, tuple(found), tuple((region, str(error)) for region, error in failed))


def nearest_region(regions: Optional[Sequence[str]] = None) -> str:
    """
    Return the region that a connection reaches first; measured once in a process.

    :param regions: those to choose among; None for all that every account may use.
    :raises ProviderError: none answers, and nobody knows where this computer is.
    """
    return places.nearest(regions)


def cheapest_type(
    region: str, *, arch: Optional[str] = None, min_cpu: Optional[int] = None,
    min_memory_gb: Optional[float] = None, cpu_type: Optional[str] = None,
    gpu: Union[bool, int, str, None] = None, gpu_memory_gb: Optional[float] = None,
    max_price: Union[Decimal, str, float, None] = None, spot: bool = False,
    market: Optional[Market] = None,
) -> str:
    """
    Return the name of the cheapest type in a region that has at least what is asked for.

    See :func:`wants` for the parameters and :func:`choose` for the errors.
    """
    asked = wants(arch=arch, min_cpu=min_cpu, min_memory_gb=min_memory_gb, cpu_type=cpu_type,
                  gpu=gpu, gpu_memory_gb=gpu_memory_gb, max_price=max_price, spot=spot)
    return choose([region], asked, market).chosen.type.name


def cheapest(
    regions: Optional[Sequence[str]] = None, *, arch: Optional[str] = None,
    min_cpu: Optional[int] = None, min_memory_gb: Optional[float] = None,
    cpu_type: Optional[str] = None, gpu: Union[bool, int, str, None] = None,
    gpu_memory_gb: Optional[float] = None, max_price: Union[Decimal, str, float, None] = None,
    spot: bool = False, market: Optional[Market] = None,
) -> Offer:
    """
    Return the cheapest offer in some regions (None: all that every account may use).

    See :func:`wants` for the parameters and :func:`choose` for the errors.
    """
    asked = wants(arch=arch, min_cpu=min_cpu, min_memory_gb=min_memory_gb, cpu_type=cpu_type,
                  gpu=gpu, gpu_memory_gb=gpu_memory_gb, max_price=max_price, spot=spot)
    return choose(list(regions or places.ENABLED), asked, market).chosen


def find_cheapest_ec2_instance_type(
    region_name: str, cpu_architecture: str = 'x86_64', default_cores: int = 2,
    default_threads_per_core: int = 1, gpu: bool = False, *, market: Optional[Market] = None,
) -> str:
    """
    Return the cheapest type as FogROS2 looks for it: with exactly so many cores and threads.

    The price is that of the region asked for, compared as a number.
    """
    asked = wants(arch=cpu_architecture, min_cpu=0, min_memory_gb=0, gpu=gpu,
                  cores=default_cores, threads_per_core=default_threads_per_core)
    return choose([region_name], asked, market).chosen.type.name


def price_of(
    region: str, name: str, *, spot: bool = False, market: Optional[Market] = None,
) -> Decimal:
    """
    Return what a type costs by the hour (US dollars).

    :raises ProviderError: the region doesn't sell it so.
    """
    market = market or Market()
    price = cheapest_zone(zones := market.spot(region, [name]).get(name, {}), zones) if spot \
        else market.price(region, name)
    if price is None:
        raise ProviderError(f"AWS tells no {'spot ' if spot else ''}price of {name} in {region}",
                            'ros2 fog price --region shows the types that a region has')
    return price


def regions_named(names: Optional[Sequence[str]], account: Optional[Account] = None) -> list[str]:
    """
    Return the regions that somebody means: 'all', 'nearest', their names; none is the usual one.

    :raises FogError: AWS can't be asked, or no region answers.
    """
    account = account or usual()
    # looked for first: measuring takes seconds, and helps nobody who can't ask for prices
    account.check_credentials()
    names = [name for name in names or () if name]
    if not names:
        return [account.region() or nearest_region()]
    if {'all', '*'} & set(names):
        return enabled_regions(account)
    return list(dict.fromkeys(nearest_region() if name == 'nearest' else name for name in names))


def enabled_regions(account: Account) -> list[str]:
    """
    Return the regions that the account may use; one request.

    :raises FogError: AWS refused, or can't be reached.
    """
    answer = account.call('ec2', account.region() or 'us-east-1', 'describe_regions',
                          'asking for the regions of the account', hasty=True)
    return sorted(region['RegionName'] for region in answer['Regions'])
