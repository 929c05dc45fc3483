# SPDX-License-Identifier: Apache-2.0
"""
Create a machine: what it needs first, then one attempt after another to get capacity.

Each place has its own idempotency token, derived from the request's token, so that a repeated
request asks for the same machine. A failed creation deletes what it has created.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
import contextlib
import dataclasses
from decimal import Decimal
import time
from typing import Any, Optional

from fogros2.errors import ConfigurationError, FogError, NameTaken, ProviderError
from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider import TAG_NAME, TAG_ROBOT
from fogros2.provider.vm.cloud import (
    CloudError,
    Order,
    own_tags,
    Place,
    TAG_ATTEMPT,
    TAG_HOST_KEY,
    TAG_MADE,
    TAG_PRICE,
    VmCloud,
    VmId,
)
from fogros2.provider.vm.host_key import one_time
from fogros2.provider.vm.options import VmOptions
from fogros2.provider.vm.user_data import cloud_config, user_data


@dataclasses.dataclass
class Creation:
    """
    One request for a machine, over regions, types and zones.

    :param cloud: its calls end with the launch.
    :param lasting: the same cloud for clean-up, which continues after the launch's end.
    :param sources: returns the networks that may log in, if ``ssh_from=`` names none.
    :param price: returns the price of a type, given its region and name, in US dollars per hour;
        None if it is unknown.
    :param zone: where its volumes are, '' for any.
    :param unsure: whether a machine may exist although no answer said so.
    :param undo_failures: errors of undo steps.
    """

    cloud: VmCloud
    lasting: VmCloud
    spec: MachineSpec
    request: CreateRequest
    options: VmOptions
    sources: Callable[[], list[str]]
    price: Callable[[str, str], Optional[Decimal]]
    zone: str = ''
    unsure: bool = False
    undo_failures: list[FogError] = dataclasses.field(default_factory=list)

    def run(self, regions: list[str]) -> VmId:
        """
        Create the machine in the first region that has capacity for one of the types.

        :raises NameTaken: a machine of this name exists, created with another token.
        :raises FogError: the first refusal; nothing is left behind.
        """
        try:
            return self._in_regions(regions)
        except FogError as error:
            error.refused = not self.unsure
            error.undo_failures = tuple(self.undo_failures)
            raise

    def _in_regions(self, regions: list[str]) -> VmId:
        first: Optional[CloudError] = None
        for region in regions:
            try:
                return self._in_region(region, self.options.in_region(region))
            except ConfigurationError:
                if first is None:
                    raise
                # a further region without the type: the first region's error counts
            except CloudError as error:
                if not error.full:
                    raise
                first = first or error
        assert first is not None, 'there is a region to try'
        raise first

    def _in_region(self, region: str, options: VmOptions) -> VmId:
        tags = own_tags(self.spec, self.request, options)
        with ThreadPoolExecutor(4, 'fog-vm') as pool:
            # all look-ups come before the first creation, at the same time
            lookup = pool.submit(self._existing, region, tags[TAG_ATTEMPT])
            sources = pool.submit(lambda: list(options.ssh_from) or self.sources())
            data = pool.submit(self._user_data, region, options, tags)
            order = Order(self.spec, self.request, options, tags, b'', (), self.zone)
            prepared = pool.submit(self.cloud.prepare, region, order, options.types)
            existing = lookup.result()
            if existing is not None:
                return existing
            ready = prepared.result()
            order = dataclasses.replace(
                order, sources=sources.result(), user_data=data.result())
        return self._make(region, order, ready)

    def _existing(self, region: str, attempt: str) -> Optional[VmId]:
        """Return the machine that an earlier call with this token created, or None."""
        vms = [*self.cloud.find(region, {TAG_NAME: self.spec.name})]
        for vm in vms:
            if vm.tags.get(TAG_ATTEMPT) == attempt:
                return VmId(region, vm.id, attempt)
        for vm in vms:
            owner = vm.tags.get(TAG_ROBOT, '')
            whose = f" of the robot '{owner}'" if owner else ''
            raise NameTaken(
                f"there is a machine '{self.spec.name}'{whose} in {region} already",
                f'give the machine another name=, or: ros2 fog delete {self.spec.name}')
        return None

    def _user_data(self, region: str, options: VmOptions, tags: Mapping[str, str]) -> bytes:
        agent = self.request.agent_config
        if agent:
            machine = VmId(region, '', tags[TAG_ATTEMPT])
            agent = {**agent, 'end_command': list(self.cloud.end_command(machine, tags))}
        return user_data(cloud_config(
            name=self.spec.name, user=options.user,
            authorized_keys=[self.request.authorized_key, *options.fleet],
            host_key=one_time(self.request.token), agent_config=agent,
            boot=self.cloud.boot))

    def _make(self, region: str, order: Order, prepared: Mapping[str, Any]) -> VmId:
        created: list[str] = []
        with contextlib.ExitStack() as undo:
            undo.callback(self._undo_begin, region, order.attempt, created)
            # the answer to a successful request may be lost
            undo.callback(self._undo, region, 'the instance', self._end, region, order.attempt)
            self.cloud.begin(region, dataclasses.replace(
                order, tags={**order.tags, TAG_MADE: str(int(time.time()))}), created)
            vm = self._first_with_room(region, order, prepared, created)
            undo.pop_all()
            return VmId(region, vm, order.attempt)

    def _end(self, region: str, attempt: str) -> None:
        try:
            if self.lasting.end_attempt(region, attempt):
                self.unsure = False
        except FogError:
            self.unsure = True  # the caller may find the machine by its tags
            raise

    def _undo_begin(self, region: str, attempt: str, created: list[str]) -> None:
        for what, undo in self.lasting.undo_begin(region, attempt, created):
            self._undo(region, what, undo)

    def _undo(self, region: str, what: str, undo: Callable[..., object], *words: str) -> None:
        """Run an undo step; record its error, so that the other steps run."""
        try:
            undo(*words)
        except FogError as error:
            self.undo_failures.append(ProviderError(
                f"{what} of '{self.spec.name}' in {region} may be left: {error.args[0]}",
                'ros2 fog gc deletes it, a quarter of an hour after it was made'))

    def _first_with_room(
        self, region: str, order: Order, prepared: Mapping[str, Any], created: list[str],
    ) -> str:
        refused: Optional[CloudError] = None
        full: set[str] = set()
        tags = {**order.tags, TAG_HOST_KEY: one_time(self.request.token).public}
        for place in self._places(region, order, list(prepared)):
            if place.kind in full:
                continue
            price = self.price(region, place.kind)
            if self._too_dear(price):
                continue
            priced = {} if price is None else {TAG_PRICE: str(price)}
            try:
                return self.cloud.insert(
                    place, order, prepared[place.kind], created, {**tags, **priced})
            except FogError as error:
                self.unsure = self.unsure or error.refused is False
                if not isinstance(error, CloudError) or not error.full:
                    raise
                # a quota holds for the whole region, a lack of machines for a zone
                if error.full == 'region':
                    full.add(place.kind)
                refused = error
        limit = self.options.max_price
        raise refused or CloudError(
            f"{self.cloud.title} has no {' or '.join(order.options.types)} in {region}"
            + ('' if limit is None else f' that is known to cost at most max_price={limit}'),
            'ros2 fog price --region shows what it has', full='zone')

    def _too_dear(self, price: Optional[Decimal]) -> bool:
        """Return whether a price may be above the limit; the cloud checks a spot price itself."""
        limit = self.options.max_price
        if limit is None:
            return False
        return not self.options.spot if price is None else price > limit

    def _places(self, region: str, order: Order, types: list[str]) -> Iterator[Place]:
        """Yield the places: all zones of the first type, then of the next."""
        zones: list[str] = []
        more = iter(self.cloud.places(region, order))
        for kind in types:
            yield from [Place(region, kind, zone) for zone in zones]
            for zone in more:  # only while the first type is tried
                zones.append(zone)
                yield Place(region, kind, zone)
