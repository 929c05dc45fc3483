# SPDX-License-Identifier: Apache-2.0
"""
How a machine is made: its group and key, then one try after another to get an instance.

Every try has its own client token that follows from the request's, so that asking again under the
same token asks for the same machine. What was made for nothing is taken away again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
import contextlib
from decimal import Decimal
import time
from typing import Any, Optional

from fogros2.errors import ConfigurationError, FogError, NameTaken, ProviderError
from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider import TAG_NAME, TAG_ROBOT
from fogros2.provider.aws import ending, images, instances, network
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.failures import AwsError, NO_ROOM, NO_ROOM_IN_REGION
from fogros2.provider.aws.host_key import one_time
from fogros2.provider.aws.images import Kind
from fogros2.provider.aws.instances import MachineId, Place, TAG_ATTEMPT, TAG_MADE
from fogros2.provider.aws.options import DEFAULT_TYPE, Options
from fogros2.provider.aws.user_data import user_data

#: Returns what a machine costs by the hour (US dollars), None where nobody knows.
Price = Callable[[str, str], Optional[Decimal]]
#: Seconds that an undo waits for what is ending.
PATIENCE = 120.0


class Creation:
    """
    One request for a machine, in as many regions and zones as it takes.

    :param robot_address: asked only where no ``ssh_from=`` names who may log in.
    :param price: of a type in a region.
    """

    def __init__(
        self, account: Account, spec: MachineSpec, request: CreateRequest, options: Options, *,
        robot_address: Callable[[], list[str]], price: Price,
    ) -> None:
        #: For the way back, whatever AWS throttles on the way there, which ends with the launch.
        self._lasting = account.apart()
        self.account = account.until(request.cancel)
        self.spec = spec
        self.request = request
        #: Those of the region that is tried.
        self.options = options
        self._all_options = options
        self.attempt = instances.attempt_of(request.token)
        self._robot_address = robot_address
        self._ask_price = price
        self._prices: dict[tuple[str, str], Optional[Decimal]] = {}
        #: Whether an instance may have been made that nobody has told us of.
        self._unsure = False
        #: What could not be taken away again.
        self.undo_failures: list[FogError] = []
        self._images: dict[tuple[str, str, bool], Mapping[str, Any]] = {}

    def run(self, regions: list[str]) -> MachineId:
        """
        Return the machine, in the first of the regions that has room for one of the types.

        :raises NameTaken: a machine of that name is there, made under another token.
        :raises FogError: see :mod:`~fogros2.provider.aws.failures`; nothing is left behind.
        """
        try:
            return self._in_regions(regions)
        except FogError as error:
            error.refused = not self._unsure
            error.undo_failures = tuple(self.undo_failures)
            raise

    def _in_regions(self, regions: list[str]) -> MachineId:
        first: Optional[AwsError] = None
        for region in regions:
            try:
                self.options = self._all_options.in_region(region)
                return self._in_region(region, list(dict.fromkeys([
                    self.options.ec2_instance_type or DEFAULT_TYPE,
                    *self.options.instance_types])))
            except ConfigurationError:
                if first is None:
                    raise
                # a region to go on in that lacks the type: what the first one said counts
            except AwsError as error:
                if error.code not in NO_ROOM:
                    raise
                first = first or error
        assert first is not None, 'there is a region to try'
        raise first

    def _in_region(self, region: str, types: list[str]) -> MachineId:
        with ThreadPoolExecutor(5, 'fog-aws') as pool:
            # all of it before anything is made; side by side, since each is a way there and back
            there = pool.submit(self._existing, region)
            asked = pool.submit(images.kinds, self.account, region, types)
            sources = pool.submit(self._sources)
            data = pool.submit(self._user_data)
            vpc = pool.submit(network.vpc_of, self.account, region, self.options.subnet) \
                if self.options.subnet else None
            found = there.result()
            if found is not None:
                return found
            chosen = [(kind, self._image(region, kind)) for kind in asked.result()]
            return self._make(region, chosen, sources.result(), _done(vpc), data.result())

    def _existing(self, region: str) -> Optional[MachineId]:
        """Return the machine that an earlier call with this token made, None for none."""
        found = instances.instances_in(self.account.pages(
            'ec2', region, 'describe_instances', 'Reservations',
            f"looking for machines called '{self.spec.name}'",
            Filters=[*instances.tag_filters({TAG_NAME: self.spec.name}),
                     {'Name': 'instance-state-name', 'Values': list(instances.ALIVE)}]))
        for instance in found:
            tags = instances.tags_of(instance)
            if tags[TAG_ATTEMPT] == self.attempt:
                return MachineId(region, instance['InstanceId'], self.attempt)
        for instance in found:
            owner = instances.tags_of(instance).get(TAG_ROBOT, '')
            whose = f" of the robot '{owner}'" if owner else ''
            raise NameTaken(
                f"there is a machine '{self.spec.name}'{whose} in {region} already",
                f'give the machine another name=, or: ros2 fog delete {self.spec.name}')
        return None

    def _price(self, region: str, kind: str) -> Optional[Decimal]:
        if (region, kind) not in self._prices:
            self._prices[region, kind] = self._ask_price(region, kind)
        return self._prices[region, kind]

    def _sources(self) -> list[str]:
        return list(self.options.ssh_from) or self._robot_address()

    def _image(self, region: str, kind: Kind) -> Mapping[str, Any]:
        """Return a kind's image, asked once for all kinds that take the same."""
        key = (region, kind.arch, kind.nvidia)
        if key not in self._images:
            self._images[key] = images.choose(
                self.account, region, kind, self.options, self.request.dependencies)
        return self._images[key]

    def _user_data(self) -> bytes:
        return user_data(
            name=self.spec.name, user=self.options.user,
            authorized_key=self.request.authorized_key, host_key=one_time(self.request.token),
            agent_config=self.request.agent_config)

    def _make(
        self, region: str, chosen: list[tuple[Kind, Mapping[str, Any]]], sources: list[str],
        vpc: str, data: bytes,
    ) -> MachineId:
        tags = instances.own_tags(self.spec, self.request, self.options)
        groups: list[str] = []
        with contextlib.ExitStack() as undo:
            # in this order: an undo of what was not made yet finds nothing, and that is fine
            undo.callback(self._undo, region, 'the security group', lambda: ending.drop_groups(
                self._lasting, region, self.attempt, known=groups, timeout=PATIENCE))
            undo.callback(self._undo, region, 'the login key', lambda: ending.drop_key(
                self._lasting, region, self.attempt))
            # an answer that got lost may have been a yes
            undo.callback(self._undo, region, 'the instance', self._end_instances, region)
            with ThreadPoolExecutor(1, 'fog-aws') as pool:
                made = {**tags, TAG_MADE: str(int(time.time()))}
                importing = pool.submit(self._import_key, region, made)
                groups.append(network.create_group(
                    self.account, region, attempt=self.attempt, name=self.spec.name, vpc=vpc,
                    tags=made))
                network.open_group(
                    self.account, region, groups[0], attempt=self.attempt, name=self.spec.name,
                    vpn_port=self.request.vpn_port, sources=sources)
                importing.result()
            instance = self._first_with_room(region, chosen, groups[0], {
                **tags, instances.TAG_HOST_KEY: one_time(self.request.token).public}, data)
            undo.pop_all()
            return MachineId(region, instance, self.attempt)

    def _end_instances(self, region: str) -> None:
        try:
            ending.end_instances(self._lasting, region, self.attempt)
        except FogError:
            self._unsure = True  # who asked for the machine may find it, and end it
            raise

    def _undo(self, region: str, what: str, undo: Callable[..., None], *words: str) -> None:
        """Undo, and go on undoing where that fails: the first error is the one to raise."""
        try:
            undo(*words)
        except FogError as error:
            self.undo_failures.append(ProviderError(
                f"{what} of '{self.spec.name}' in {region} may be left: {error.args[0]}",
                'ros2 fog gc deletes it, a quarter of an hour after it was made'))

    def _first_with_room(
        self, region: str, chosen: list[tuple[Kind, Mapping[str, Any]]], group: str,
        tags: dict[str, str], data: bytes,
    ) -> str:
        image_of = {kind.name: image for kind, image in chosen}
        refused: Optional[AwsError] = None
        full: set[str] = set()
        for place in self._places(region, list(image_of)):
            if place.kind in full:
                continue
            price = self._price(region, place.kind)
            if self._too_dear(price):
                continue
            priced = {} if price is None else {instances.TAG_PRICE: str(price)}
            words = instances.run_request(
                self.spec, self.request, self.options, place=place, image=image_of[place.kind],
                group=group, tags={**tags, **priced}, user_data=data)
            try:
                answer = self.account.call(
                    'ec2', region, 'run_instances',
                    f"creating '{self.spec.name}' ({place.kind})", **words)
            except FogError as error:
                self._unsure = self._unsure or not error.refused
                if not isinstance(error, AwsError) or error.code not in NO_ROOM:
                    raise
                # a quota holds for the whole region, a lack of machines for a zone
                if error.code in NO_ROOM_IN_REGION:
                    full.add(place.kind)
                refused = error
                continue
            return str(answer['Instances'][0]['InstanceId'])
        raise refused or AwsError(
            f"no machine for '{self.spec.name}' in {region} is known to cost at most "
            f'max_price={self.options.max_price}', 'ros2 fog price shows what there is',
            code='SpotMaxPriceTooLow')

    def _too_dear(self, price: Optional[Decimal]) -> bool:
        """Return whether a price is above the cap, or may be: AWS itself holds a spot price."""
        cap = self.options.max_price
        if cap is None:
            return False
        return not self.options.spot if price is None else price > cap

    def _places(self, region: str, types: list[str]) -> Iterator[Place]:
        """Yield the tries: where EC2 likes best first, then zone by zone, type by type."""
        if self.options.subnet:
            yield from (Place(region, kind, self.options.subnet) for kind in types)
            return
        subnets: Optional[list[str]] = None
        for kind in types:
            yield Place(region, kind)
            if subnets is None:  # the first had no room: who is there to ask else?
                subnets = network.default_subnets(self.account, region)
            yield from (Place(region, kind, subnet) for subnet in subnets)

    def _import_key(self, region: str, tags: Mapping[str, str]) -> None:
        try:
            self.account.call(
                'ec2', region, 'import_key_pair', f"importing the login key of '{self.spec.name}'",
                KeyName=instances.own_name(self.attempt),
                PublicKeyMaterial=self.request.authorized_key.encode(),
                TagSpecifications=[{
                    'ResourceType': 'key-pair', 'Tags': instances.tag_list(tags)}])
        except AwsError as error:
            if error.code != 'InvalidKeyPair.Duplicate':
                raise


def _done(future: Optional[Future[str]]) -> str:
    return '' if future is None else future.result()
