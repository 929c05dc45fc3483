# SPDX-License-Identifier: Apache-2.0
"""Requirements of a machine, and the types of machines that a provider offers, with prices."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
from decimal import Decimal
import platform
import re
from typing import Optional, Protocol, runtime_checkable, Union

from fogros2.errors import ConfigurationError
from fogros2.model import MachineSpec
from fogros2.provider.machine_types import MachineType

#: Minimum of 'cheapest' if a launch file names none: that of EC2's t3.medium.
MIN_CPU = 2
MIN_MEMORY_GB = 4.0
_ARCHITECTURES = {
    'x86_64': 'x86_64', 'amd64': 'x86_64', 'arm64': 'arm64', 'aarch64': 'arm64', 'any': ''}
#: The GPUs that run CUDA, which a request for a number of GPUs means.
_CUDA = 'nvidia'


@dataclasses.dataclass(frozen=True)
class Wants:
    """
    The requirements of a machine.

    :param arch: ``x86_64`` or ``arm64``; '' for either.
    :param min_cpu: minimum number of hardware threads (vCPUs).
    :param min_memory_gb: minimum memory in GiB.
    :param cpu_type: manufacturer of the processor: intel, amd, aws; '' for any.
    :param gpus: minimum number of GPUs.
    :param gpu: word of the GPU's manufacturer or name, such as 'L4'; '' for NVIDIA.
    :param gpu_memory_gb: minimum memory of each GPU in GB.
    :param max_price: maximum price in US dollars per hour; None for no limit.
    :param spot: compare spot prices.
    :param cores: exact number of physical cores, as FogROS2 asks; None for any.
    :param threads_per_core: exact number, as FogROS2 asks; None for any.
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

    :param price: US dollars per hour; None if the type is not sold on demand.
    :param spot_price: the same for a spot machine in its cheapest zone now.
    :param zones: the zones of the region that have the type.
    :param provider: name of the provider, '' while only one is asked.
    :param round_trip_ms: measured time to the region and back, None if it was not measured.
    """

    region: str
    type: MachineType
    price: Optional[Decimal] = None
    spot_price: Optional[Decimal] = None
    zones: tuple[str, ...] = ()
    provider: str = ''
    round_trip_ms: Optional[float] = None

    def __str__(self) -> str:
        return f'{self.type.name} of {self.provider} in {self.region}'

    def cost(self, spot: bool) -> Optional[Decimal]:
        """Return the spot price or the price on demand."""
        return self.spot_price if spot else self.price


@dataclasses.dataclass(frozen=True)
class Offers:
    """
    The offers that meet requirements, the cheapest first.

    :param regions: the regions that were asked.
    :param left_out: regions that could not be asked, each with the reason.
    """

    wants: Wants
    offers: tuple[Offer, ...]
    regions: tuple[str, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()

    @property
    def chosen(self) -> Offer:
        """The cheapest offer."""
        return self.offers[0]


@runtime_checkable
class Seller(Protocol):
    """
    A source of offers.

    A provider may have these methods; for clouds of virtual machines, this feature has them.
    """

    def offers(
        self, wanted: Wants, regions: Sequence[str] = (), *, refresh: bool = False,
    ) -> Offers:
        """
        Return the types of machines that meet requirements, the cheapest first.

        :param regions: names, 'all' or 'nearest'; none for the configured one.
        :param refresh: do not use cached prices.
        :raises ConfigurationError: nothing fits.
        :raises FogError: no region answers.
        """

    def taking(self, spec: MachineSpec, offer: Offer) -> MachineSpec:
        """
        Return the spec of a machine of this provider that takes an offer.

        :param spec: of a machine of any cloud; the result has its options as ``wanted``.
        """


def wants(
    *, arch: Optional[str] = None, min_cpu: Optional[int] = None,
    min_memory_gb: Optional[float] = None, cpu_type: Optional[str] = None,
    gpu: Union[bool, int, str, None] = None, gpu_memory_gb: Optional[float] = None,
    max_price: Union[Decimal, str, float, None] = None, spot: bool = False,
    cores: Optional[int] = None, threads_per_core: Optional[int] = None,
) -> Wants:
    """
    Check the requirements of a launch file or a command line; see :class:`Wants`.

    :param arch: None for this computer's own, so that a compiled workspace runs there.
    :param gpu: a number, True for one, or part of the name of one.
    :raises ConfigurationError: a value is out of range.
    """
    named = gpu if isinstance(gpu, str) and not gpu.isdecimal() else ''
    number = 1 if named or gpu is True else int(gpu or 0)
    if gpu_memory_gb and not number:
        number = 1
    architecture = platform.machine() if arch is None else arch
    if architecture.lower() not in _ARCHITECTURES:
        raise ConfigurationError(f"no machine has the architecture '{architecture}'",
                                 'there are x86_64, arm64 and any')
    for name, value in (('min_cpu', min_cpu), ('min_memory_gb', min_memory_gb), ('gpu', number),
                        ('gpu_memory_gb', gpu_memory_gb), ('cores', cores),
                        ('threads_per_core', threads_per_core)):
        if value is not None and not 0 <= value < 1_000_000:
            raise ConfigurationError(f'{name} can not be {value:g}',
                                     'it takes a number from 0 to a million')
    return Wants(
        _ARCHITECTURES[architecture.lower()], MIN_CPU if min_cpu is None else int(min_cpu),
        MIN_MEMORY_GB if min_memory_gb is None else float(min_memory_gb), cpu_type or '', number,
        named, float(gpu_memory_gb or 0), dollars(max_price), spot, cores, threads_per_core)


def dollars(value: Union[Decimal, str, float, None]) -> Optional[Decimal]:
    """
    Convert a price to a Decimal, None to None.

    :raises ConfigurationError: not a number above 0.
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


def fits(kind: MachineType, wanted: Wants) -> bool:
    """Return whether a type meets the requirements, except for its price."""
    return ((not wanted.arch or kind.arch == wanted.arch)
            and kind.vcpus >= wanted.min_cpu
            and kind.memory_gb >= wanted.min_memory_gb
            and wanted.cpu_type.lower() in kind.cpu.lower()
            and (not wanted.spot or kind.spot)
            and (not wanted.gpus or kind.gpus >= wanted.gpus and _is_gpu(kind, wanted))
            and (wanted.cores is None or kind.cores == wanted.cores)
            and (wanted.threads_per_core is None
                 or kind.vcpus == wanted.threads_per_core * kind.cores))


def _is_gpu(kind: MachineType, wanted: Wants) -> bool:
    # clouds report GiB, people ask for GB: a card of '24 GB' has 22.4 GiB
    gigabytes = kind.gpu_memory_gb * 1.024 ** 3 + 0.1
    named = re.search(rf'\b{re.escape(wanted.gpu or _CUDA)}\b', kind.gpu, re.IGNORECASE)
    return named is not None and gigabytes >= wanted.gpu_memory_gb


def ranked(offers: Iterable[Offer], spot: bool) -> list[Offer]:
    """Return the offers that have a price, the lowest first; of two equal ones the larger."""
    priced = [(cost, offer) for offer in offers if (cost := offer.cost(spot)) is not None]
    return [offer for _, offer in sorted(priced, key=lambda pair: (
        pair[0], -pair[1].type.vcpus, -pair[1].type.memory_gb, pair[1].type.name,
        pair[1].region))]
