# SPDX-License-Identifier: Apache-2.0
"""Regions, and the types of machines that they have."""

from __future__ import annotations

import dataclasses
from typing import Optional


@dataclasses.dataclass(frozen=True)
class Region:
    """
    A region and its distance.

    :param place: its city or state, for people.
    :param milliseconds: median time to connect by TCP, which is one round trip; None if no
        connection succeeded.
    :param distance_km: distance on the globe, if no region answered.
    """

    region: str
    place: str = ''
    milliseconds: Optional[float] = None
    distance_km: Optional[float] = None


@dataclasses.dataclass(frozen=True)
class MachineType:
    """
    A type of machine.

    :param vcpus: hardware threads; ``cores`` is the number of physical cores.
    :param memory_gb: memory in GiB.
    :param arch: ``x86_64`` or ``arm64``.
    :param cpu: manufacturer of the processor: Intel, AMD, AWS.
    :param gpus: number of GPUs, with ``gpu_memory_gb`` GiB each.
    :param gpu: manufacturer and name, such as 'NVIDIA T4'.
    :param spot: whether it exists as a spot machine.
    """

    name: str
    vcpus: int
    cores: int
    memory_gb: float
    arch: str
    cpu: str = ''
    gpus: int = 0
    gpu: str = ''
    gpu_memory_gb: float = 0.0
    spot: bool = False
