# SPDX-License-Identifier: Apache-2.0
"""List the volumes of all providers that have some."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
from decimal import Decimal
from typing import Any, Optional

from fogros2 import plugin_system
from fogros2.model import Volume
from fogros2.provider import Provider
from fogros2_features.volumes.keepers import volume_keeper
from ros2fog_cli.api import machines, table
from ros2fog_cli.api.machines import Warn


def survey(
    warn: Warn, *, regions: Optional[Sequence[str]] = None, hosts: Sequence[str] = (),
) -> list[Volume]:
    """Return the volumes of all providers; warn about a provider that does not answer."""
    def ask(name: str) -> Iterable[Volume]:
        kind: type[Provider] = plugin_system.load('fogros2.provider', name)
        return volume_keeper(machines.load(name, regions)).volumes(hosts) \
            if kind.capabilities.keeps_volumes else ()

    return sorted(machines.gather(warn, regions, ask),
                  key=lambda volume: (volume.name, volume.id))


def to_json(volume: Volume) -> dict[str, Any]:
    """Return a volume as JSON data: size in GB, prices in US dollars."""
    fields = dataclasses.asdict(volume)
    cost, place = volume.cost_per_month, fields.pop('region')
    del fields['gb_month']
    return {**fields, 'place': place, 'cost_per_month': None if cost is None else float(cost)}


def listed(regions: Optional[Sequence[str]]) -> tuple[list[dict[str, Any]], str]:
    """
    Return volumes as JSON data, and what they cost together, for ``ros2 fog list``.

    ``--json`` prints the first by the name of the entry point. The text is '' without a price.

    :param regions: as the user has named them, None for the usual ones.
    """
    volumes = survey(lambda text: None, regions=regions)  # the list of machines warns
    costs = [each for volume in volumes if (each := volume.cost_per_month) is not None]
    return list(map(to_json, volumes)), (
        f'volumes: about {table.cost(sum(costs, Decimal(0)), 2)} a month (ros2 fog volume list)'
        if costs else '')
