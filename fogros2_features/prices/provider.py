# SPDX-License-Identifier: Apache-2.0
"""A machine of any cloud: it becomes a machine of the cloud with the cheapest offer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import ClassVar

from fogros2 import plugin_system
from fogros2.errors import ConfigurationError, MachineNotFound, Unsupported
from fogros2.model import CreateRequest, Machine, MachineSpec
from fogros2.provider import Capabilities, Provider
from fogros2_features.prices.offers import Wants, wants

#: Options that are requirements; see :func:`fogros2_features.prices.offers.wants`.
WANTS = ('arch', 'min_cpu', 'min_memory_gb', 'cpu_type', 'gpu', 'gpu_memory_gb', 'max_price',
         'spot')
#: Number of offers to try; the cheapest of each other cloud comes in addition.
TRIES = 6


class Cheapest(Provider):
    """
    Stands for the cloud of a machine until the launch chooses one with :meth:`places`.

    No machine ever belongs to it: records and tags name the chosen cloud.
    """

    name: ClassVar[str] = 'cheapest'
    capabilities: ClassVar[Capabilities] = Capabilities(places=True)

    def check(self, spec: MachineSpec) -> None:
        """Check the requirements without a request."""
        _wants(spec)
        for name in spec.options.get('providers') or ():
            plugin_system.load('fogros2.provider', name)

    def places(self, spec: MachineSpec) -> list[tuple[str, MachineSpec]]:
        """
        Return the offers to try, the cheapest first, each with the spec of its machine.

        :raises FogError: nothing fits, or no cloud answers.
        """
        # what clouds share is loaded when they are asked
        from fogros2.provider.vm.provider import ALL
        from fogros2_features.prices.clouds import compare
        from fogros2_features.prices.market import seller
        offers = compare(
            _wants(spec), spec.options.get('providers') or (),
            spec.options.get('regions') or [ALL], cancel=self.cancel,
            max_round_trip_ms=spec.options.get('max_round_trip_ms')).offers
        first = {offer.provider: offer for offer in reversed(offers)}
        places = []
        for number, offer in enumerate(offers):
            if number < TRIES or first[offer.provider] is offer:
                provider: Provider = plugin_system.load('fogros2.provider', offer.provider)()
                place = seller(provider).taking(spec, offer)
                provider.check(place)
                places.append((str(offer), place))
        return places

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Refuse: the chosen cloud creates the machine."""
        raise Unsupported(f"no cloud was chosen for '{spec.name}'")

    def describe(self, machine_id: str) -> Machine:
        """Know no machine."""
        raise MachineNotFound(machine_id)

    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        """
        Refuse: the chosen clouds find the machines.

        :raises Unsupported: always.
        """
        raise Unsupported(f"provider '{self.name}' has no machines of its own")

    def destroy(self, machine_id: str) -> None:
        """Do nothing, because no machine exists."""


def _wants(spec: MachineSpec) -> Wants:
    limit = spec.options.get('max_round_trip_ms')
    if limit is not None and limit <= 0:
        raise ConfigurationError(f'max_round_trip_ms can not be {limit:g}',
                                 'it takes milliseconds above 0')
    return wants(**{name: spec.options[name] for name in WANTS if name in spec.options})
