# SPDX-License-Identifier: Apache-2.0
"""A machine of any cloud in launch files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Optional, TYPE_CHECKING

from fogros2.describe.kinds import options_of
from fogros2.describe.machines_cloud import VmInstance

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import Value


class CheapestInstance(VmInstance):
    """
    A virtual machine of the cloud with the cheapest offer, created for the launch.

    The launch compares the offers of all clouds that are set up on the robot. If a cloud has no
    capacity or quota for the cheapest, the launch takes the next offer, also of another cloud.

    Defaults: the robot's own architecture, 2 vCPUs and 4 GiB of memory.

    :param cpu_type: manufacturer of the processor: intel, amd, aws.
    :param max_round_trip_ms: maximum of the measured time to the region and back.
    :param providers: names of clouds, such as 'aws'; None for all that are set up.
    :param regions: names of regions of these clouds; None for all.
    :param disk_size: GB; default 30.
    """

    provider = 'cheapest'

    def __init__(
        self, *, cpu_type: Optional[SomeSubstitutionsType] = None,
        max_round_trip_ms: Optional[Value] = None,
        providers: Optional[Sequence[SomeSubstitutionsType]] = None,
        disk_size: Optional[Value] = None,
        **common: Any,
    ) -> None:
        super().__init__(options=options_of(CheapestInstance.__init__, locals()), **common)


#: ``machine=cheapest(min_cpu=8)`` reads like the other choices of a launch.
cheapest = CheapestInstance
