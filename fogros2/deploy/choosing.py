# SPDX-License-Identifier: Apache-2.0
"""Make the open choices of machine specs before any machine exists, and track the cost."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from decimal import Decimal
import threading
import time
from typing import Optional

from fogros2 import feature, model, plan
from fogros2.errors import FogError
from fogros2.model import MachineSpec
from fogros2.provider import Provider
from fogros2.provider.cheapest import Cheapest
from fogros2.report import Reporter, step


class Choices:
    """
    Choices and cost of one launch; thread-safe.

    :param provider: returns a provider by its name.
    """

    def __init__(self, provider: Callable[[str], Provider], report: Reporter) -> None:
        self._provider = provider
        self._report = report
        self._lock = threading.Lock()
        self._resolved: dict[str, MachineSpec] = {}
        self._places: dict[str, list[MachineSpec]] = {}
        #: Of each machine that exists, and of those that have ended.
        self._costs: dict[str, tuple[Decimal, float, Optional[float]]] = {}
        self._ended: list[tuple[str, Decimal, float]] = []

    def resolved(self, spec: MachineSpec) -> MachineSpec:
        """
        Resolve every open choice of a spec, such as 'nearest', once for each launch.

        :raises FogError: nothing fits.
        """
        key = model.to_json(spec)
        if key in self._resolved:
            return self._resolved[key]
        provider = self._provider(spec.provider)
        if not provider.capabilities.choices:
            return spec
        with step(self._report, spec.name, 'choices') as detail:
            chosen = provider.resolve(spec)
            detail += provider.choices(spec, chosen)
            price = self.price(chosen)
            if price is not None:
                detail.append(plan.price(price))
        self._resolved[key] = chosen
        return chosen

    def places(self, spec: MachineSpec) -> list[MachineSpec]:
        """
        Return the specs to try while there is no capacity, one after the other.

        For a machine of any cloud, they are the cheapest offers, requested once for each launch.

        :raises FogError: nothing fits.
        """
        provider = self._provider(spec.provider)
        if not isinstance(provider, Cheapest):
            return [spec]
        if spec.name not in self._places:
            with step(self._report, spec.name, 'offers') as detail:
                offers = provider.places(spec)
                detail += [str(offer) for offer, _ in offers[:2]]
                detail += [f'{len(offers) - 2} more'] * (len(offers) > 2)
            self._places[spec.name] = [place for _, place in offers]
        return self._places[spec.name]

    def price(self, spec: MachineSpec) -> Optional[Decimal]:
        """Return the price of a machine in US dollars per hour, None if unknown."""
        try:
            return self._provider(spec.provider).cost_per_hour(spec)
        except FogError:
            return None  # the price is only displayed; a price limit was checked before

    def limited(
        self, spec: MachineSpec, price: Optional[Decimal], *, made: bool = False,
    ) -> MachineSpec:
        """
        Return a spec with the lifetime that its features allow.

        :param price: US dollars per hour, None if unknown.
        :param made: whether the machine exists.
        :raises FogError: they allow none.
        """
        _, spent = self.spent(spec.name)
        return dataclasses.replace(spec, lifetime=min([spec.lifetime, *(
            each.lifetime(spec, price, spent, own, made=made)
            for each, own in feature.used(spec))]))

    def begin(self, name: str, price: Optional[Decimal]) -> None:
        """Start to count a machine's cost; a later call changes the price, not the start."""
        if price is None:
            return
        with self._lock:
            begin = time.monotonic()
            if name in self._costs:
                before, since, end = self._costs[name]
                if end is None:
                    begin = since
                else:
                    self._ended.append((name, before, end - since))
            self._costs[name] = (price, begin, None)

    def end(self, name: str) -> None:
        """Stop to count a machine's cost; idempotent."""
        with self._lock:
            known = self._costs.get(name)
            if known is not None and known[2] is None:
                self._costs[name] = (known[0], known[1], time.monotonic())

    def spent(self, name: str) -> tuple[Optional[Decimal], Decimal]:
        """Return a machine's US dollars per hour, None if unknown, and its cost so far."""
        costs = [(price, price * Decimal(seconds) / 3600)
                 for each, price, seconds in self.cost() if each == name]
        return (costs[-1][0] if costs else None), sum((cost for _, cost in costs), Decimal(0))

    def cost(self) -> list[tuple[str, Decimal, float]]:
        """Return (name, US dollars per hour, seconds) of each machine with a known price."""
        now = time.monotonic()
        with self._lock:
            return sorted([*self._ended, *(
                (name, price, (now if end is None else end) - begin)
                for name, (price, begin, end) in self._costs.items())], key=lambda one: one[0])
