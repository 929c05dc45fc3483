# SPDX-License-Identifier: Apache-2.0
"""
Choose an instance type when the launch is executed, as ``fogros2.describe.choices`` does.

The names and keywords of FogROS2's module ``utils.ec2_instance_type_selection`` are among them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import functools
from typing import Any, Optional, TYPE_CHECKING

from fogros2.describe import values
from fogros2.describe.choices import Choice
from fogros2.errors import ConfigurationError
from fogros2_features.prices.offers import wants
from fogros2_features.prices.provider import WANTS

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType


def find_cheapest_ec2_instance_type(
    region_name: SomeSubstitutionsType, cpu_architecture: str = 'x86_64', default_cores: int = 2,
    default_threads_per_core: int = 1, gpu: bool = False,
) -> Choice:
    """
    Choose the cheapest EC2 instance type of a region as FogROS2 does.

    It has exactly so many cores and threads. ``ec2_instance_type='cheapest'`` of a machine, and
    :func:`find_cheapest`, take minimums.

    :param region_name: such as 'eu-central-1', or 'nearest'.
    :param gpu: whether it has a GPU.
    """
    return Choice('the cheapest type there', functools.partial(_type, wanted={
        'arch': cpu_architecture, 'min_cpu': 0, 'min_memory_gb': 0, 'gpu': gpu,
        'cores': default_cores, 'threads_per_core': default_threads_per_core}),
        {'region': region_name})


def find_cheapest(
    regions: Optional[Sequence[SomeSubstitutionsType]] = None, *, provider: str = 'aws',
    max_round_trip_ms: Optional[float] = None, **wanted: Any,
) -> tuple[Choice, Choice]:
    """
    Choose the cheapest machine of a cloud that meets the requirements.

    :param regions: candidates; None for all regions that the account may use.
    :param provider: the cloud, such as 'azure'.
    :param max_round_trip_ms: maximum of the measured time to the region and back.
    :param wanted: ``arch``, ``min_cpu``, ``min_memory_gb``, ``cpu_type``, ``gpu``,
        ``gpu_memory_gb``, ``max_price``, ``spot``, with the meaning of AWSCloudInstance.
    :returns: region and type. :class:`~fogros2.CheapestInstance` compares all clouds.
    :raises ConfigurationError: an unknown keyword.
    """
    for name in wanted:
        if name not in WANTS:
            raise ConfigurationError(
                f"find_cheapest takes no '{name}'",
                f"it takes regions, provider, max_round_trip_ms, {', '.join(WANTS)}")
    ask = functools.partial(
        _cheapest, provider=provider, max_round_trip_ms=max_round_trip_ms, wanted=wanted)
    # one request answers both
    offer = Choice('the cheapest offer', ask, {'regions': values.items(regions)})
    return (Choice('the region of the cheapest offer', lambda offer: offer.split(' ')[0],
                   {'offer': offer}),
            Choice('the type of the cheapest offer', lambda offer: offer.split(' ')[1],
                   {'offer': offer}))


# What clouds share is loaded only when a request is made.

def _type(region: str, wanted: Mapping[str, Any]) -> str:
    from fogros2_features.prices.clouds import compare
    return compare(wants(**wanted), ('aws',), [region]).chosen.type.name


def _cheapest(
    regions: Optional[Sequence[str]], provider: str,
    max_round_trip_ms: Optional[float], wanted: Mapping[str, Any],
) -> str:
    from fogros2.provider.vm.provider import ALL
    from fogros2_features.prices.clouds import compare
    offer = compare(wants(**wanted), (provider,), regions or [ALL],
                    max_round_trip_ms=max_round_trip_ms).chosen
    return f'{offer.region} {offer.type.name}'
