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
from fogros2.agent.loop import boot_clock
from fogros2.errors import FogError
from fogros2.feature import Cost
from fogros2.model import Machine, MachineSpec
from fogros2.provider import Provider
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
        #: By id, machines of earlier launches that were found to run, until they are adopted.
        self.running: dict[str, Machine] = {}
        #: Of each machine that exists or will be created, with ``_clocks`` when it began,
        #: and of those that have ended.
        self._costs: dict[str, tuple[Cost, Optional[tuple[float, float]]]] = {}
        self._ended: list[Cost] = []

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
            if price := self.price(chosen):
                detail.append(plan.price(price))
        self._resolved[key] = chosen
        return chosen

    def places(self, spec: MachineSpec) -> list[MachineSpec]:
        """
        Return the specs to try while there is no capacity, one after the other.

        A provider that stands for others is asked for them once, and again after ``forget``.

        :raises FogError: nothing fits.
        """
        provider = self._provider(spec.provider)
        if not provider.capabilities.places:
            return [spec]
        if spec.name not in self._places:
            with step(self._report, spec.name, 'offers') as detail:
                places = provider.places(spec)
                detail += [words for words, _ in places[:2]]
                detail += [f'{len(places) - 2} more'] * (len(places) > 2)
            self._places[spec.name] = [place for _, place in places]
        return self._places[spec.name]

    def forget(self, name: str) -> None:
        """Let ``places`` ask anew for the offers of a machine."""
        self._places.pop(name, None)

    def price(self, spec: MachineSpec) -> Optional[Decimal]:
        """Return the price of a machine in US dollars per hour, None if unknown."""
        try:
            return self._provider(spec.provider).cost_per_hour(spec)
        except FogError:
            return None  # the price is only displayed; a price limit was checked before

    def limited(self, spec: MachineSpec, *, made: bool = False) -> MachineSpec:
        """
        Return a spec with the lifetime that its features allow; see ``expect``.

        :param made: whether the machine exists.
        :raises FogError: they allow none.
        """
        costs = self.costs()
        return dataclasses.replace(spec, lifetime=min([spec.lifetime, *(
            each.lifetime(spec, costs, own, made=made) for each, own in feature.used(spec))]))

    def expect(self, spec: MachineSpec, price: Optional[Decimal]) -> None:
        """
        Count a machine, before it exists too; a later call changes spec and price.

        :param price: US dollars per hour, None if unknown.
        """
        with self._lock:
            _, begin = self._costs.get(spec.name, (None, None))
            self._costs[spec.name] = Cost(spec, price), begin

    def begin(self, name: str) -> None:
        """Let an expected machine cost from now on; idempotent."""
        with self._lock:
            cost, begin = self._costs[name]
            self._costs[name] = cost, begin or _clocks()

    def end(self, name: str) -> None:
        """Stop to count a machine's cost; idempotent."""
        with self._lock:
            cost, begin = self._costs.pop(name, (None, None))
            if cost is not None and begin is not None:
                self._ended.append(dataclasses.replace(_until_now(cost, begin), ended=True))

    def costs(self) -> list[Cost]:
        """Return what all machines of the launch cost, in the order of their names."""
        with self._lock:
            return sorted([*self._ended, *(
                cost if begin is None else _until_now(cost, begin)
                for cost, begin in self._costs.values())], key=lambda cost: cost.spec.name)


def _clocks() -> tuple[float, float]:
    """Return seconds with and without the time for which this computer was suspended."""
    return boot_clock(), time.monotonic()


def _until_now(cost: Cost, begin: tuple[float, float]) -> Cost:
    # a machine that is not kept ends robot_timeout after the robot is suspended
    passed, awake = (now - then for now, then in zip(_clocks(), begin))
    longest = passed if cost.spec.on_exit == 'keep' else awake + cost.spec.robot_timeout
    return dataclasses.replace(cost, seconds=min(passed, longest))
