# SPDX-License-Identifier: Apache-2.0
"""The adapter of a cloud of virtual machines, and the data that it exchanges with the provider."""

from __future__ import annotations

import abc
import collections
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
import copy
import dataclasses
import datetime
from decimal import Decimal
import hashlib
import logging
import re
import threading
from typing import Any, ClassVar, Literal, NamedTuple, Optional, TypeVar
import uuid

from fogros2.errors import ProviderError, Unsupported
from fogros2.model import CreateRequest, MachineSpec, MachineState
from fogros2.provider import SETTLED, TAG_DEPENDENCIES, TAG_NAME, TAG_ROBOT
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.options import VmOptions
from fogros2.provider.vm.regions import Regions
from fogros2.provider.vm.user_data import END_COMMAND
from fogros2.store import is_another_robot

#: Seconds in which a machine has to end or to stop; usually it is half a minute.
END_TIMEOUT = 300.0
#: The tag of every resource of one machine: it identifies the attempt that created them.
TAG_ATTEMPT = 'fogros2-attempt'
TAG_HOST_KEY = 'fogros2-host-key'
TAG_USER = 'fogros2-user'
TAG_DISK = 'fogros2-disk-gb'
TAG_PRICE = 'fogros2-price-per-hour'
TAG_SSH_FROM = 'fogros2-ssh-from'
#: Only on images: the image's name, and 'nvidia' if it has NVIDIA's driver.
TAG_BAKED = 'fogros2-baked'
TAG_DRIVER = 'fogros2-driver'
#: Only on resources beside the machine: seconds since the epoch of their creation.
TAG_MADE = 'fogros2-made'
#: Seconds for which prices are used again; for types and zones: ``VmCloud.types_age``.
PRICES_AGE = 86400.0
#: Only on disks that outlive machines: the volume's name.
TAG_VOLUME = 'fogros2-volume'
_LOGGER = logging.getLogger(__name__)

Adapter = TypeVar('Adapter', bound='VmCloud')


class CloudError(ProviderError):
    """
    A cloud refused a request; set ``refused`` to False if it may have had an effect.

    :param full: no capacity in this zone, or the quota of this region is used up.
    :param gone: the resource does not exist (any more).
    :param denied: these credentials must not do that.
    """

    refused = True

    def __init__(
        self, message: str, hint: str = '', *, full: Literal['', 'zone', 'region'] = '',
        gone: bool = False, denied: bool = False,
    ) -> None:
        super().__init__(message, hint)
        self.full = full
        self.no_capacity = bool(full)
        self.gone = gone
        self.denied = denied


class VmId(NamedTuple):
    """The parts of a machine's id: region, the cloud's id, the attempt that created it."""

    region: str
    vm: str
    attempt: str


class Place(NamedTuple):
    """Where a machine is tried: region, type, and a zone or subnet; '' for any."""

    region: str
    kind: str
    zone: str = ''


@dataclasses.dataclass(frozen=True)
class Vm:
    """
    A virtual machine as its cloud reports it.

    :param address: address at which the robot reaches it, '' while it has none.
    :param private_network: name of its private network, '' if it shares none.
    :param spot: whether the cloud may reclaim it.
    :param created: seconds since the epoch; ``stopped`` is when it was stopped.
    :param billed: it is stopped, and costs as much as a running one.
    :param key: the cloud's name of its login key.
    :param reason: why it ended, in the cloud's words.
    """

    id: str
    region: str
    state: MachineState
    tags: Mapping[str, str]
    kind: str = ''
    spot: bool = False
    address: str = ''
    private_network: str = ''
    private_ip: str = ''
    created: Optional[float] = None
    stopped: Optional[float] = None
    image: str = ''
    key: str = ''
    reason: str = ''
    billed: bool = False


@dataclasses.dataclass(frozen=True)
class Disk:
    """
    A volume as its cloud reports it.

    :param zone: '' if machines in the whole region can use it.
    :param vm: the cloud's id of the machine that has it, '' for none.
    :param ready: it is neither being made, attached nor detached.
    :param created: seconds since the epoch. Of several with one name, the one in use counts, and
        else the first.
    """

    id: str
    name: str
    region: str
    zone: str
    size_gb: int
    vm: str = ''
    ready: bool = True
    created: float = 0.0


@dataclasses.dataclass(frozen=True)
class Order:
    """
    A request for a machine, the same in every region and zone that is tried.

    :param options: of the cloud's class, with the values for the region.
    :param tags: for the machine and every resource beside it.
    :param sources: networks (CIDR) that may reach the SSH port.
    :param zone: where its volumes are, '' for any.
    """

    spec: MachineSpec
    request: CreateRequest
    options: Any
    tags: Mapping[str, str]
    user_data: bytes
    sources: Sequence[str]
    zone: str = ''

    @property
    def attempt(self) -> str:
        """The name of the attempt, for names and tags of resources."""
        return self.tags[TAG_ATTEMPT]

    def token(self, place: Place) -> str:
        """Return the idempotency token for one place; the same for the same place."""
        words = f'fogros2:{self.request.token}:{"/".join(place)}'
        return str(uuid.uuid5(uuid.NAMESPACE_URL, words))


def attempt_of(token: str) -> str:
    """Return the attempt's name, from which the token cannot be derived."""
    return hashlib.sha256(b'fogros2 attempt\0' + token.encode()).hexdigest()[:16]


def own_name(attempt: str) -> str:
    """Return the name of the resources of an attempt (firewall, key)."""
    return f'fogros2-{attempt}'


def made_at(tags: Mapping[str, str]) -> Optional[float]:
    """Return when a resource was made: seconds since the epoch, 0 without a tag, None if bad."""
    text = tags.get(TAG_MADE, '0')
    return float(text) if text.isdecimal() else None


def when(text: Any) -> Optional[float]:
    """Return a cloud's ISO 8601 time as seconds since the epoch, None if it is none."""
    try:
        # Python 3.10 takes no 'Z', and only three or six decimals
        plain = re.sub(r'\.\d+', '', str(text).replace('Z', '+00:00'))
        return datetime.datetime.fromisoformat(plain).timestamp()
    except ValueError:
        return None


def own_tags(
    spec: MachineSpec, request: CreateRequest, options: VmOptions,
) -> dict[str, str]:
    """Return the tags of every resource that is created for a machine."""
    tags = {**options.tags, 'Name': spec.name, **request.tags, TAG_NAME: spec.name,
            TAG_ATTEMPT: attempt_of(request.token), TAG_USER: options.user,
            TAG_DEPENDENCIES: request.dependencies, TAG_SSH_FROM: ' '.join(options.ssh_from)}
    return {key: value for key, value in tags.items() if value}


class VmCloud(abc.ABC):
    """
    The API of one cloud. All methods may be called by several threads at the same time.

    A method raises :class:`CloudError` if the cloud refuses, with ``refused`` set to False if the
    request may have had an effect, and PrerequisiteError if the cloud cannot be asked.
    """

    #: Name of the provider, and of the cloud for people.
    name: ClassVar[str]
    title: ClassVar[str]
    options: ClassVar[type[VmOptions]]
    regions: ClassVar[Regions]
    #: Regular expression, without groups, of the cloud's ids of machines; its regions are
    #: ``[a-z0-9-]+``.
    id_form: ClassVar[str]
    #: Region for requests that belong to no region.
    base_region: ClassVar[str]
    #: A shell script that each machine runs at each boot, before its SSH server and agent.
    boot: ClassVar[str] = ''
    #: The usual price of a GB of a volume in US dollars a month, None without volumes.
    gb_month: ClassVar[Optional[Decimal]] = None
    #: Seconds for which ``types`` and ``zones`` are used again. They are few, because a type that
    #: has no capacity now may be left out; a cloud that lists all types may set a day.
    types_age: ClassVar[float] = 300.0
    #: Notes for people about machines that this process has created, by the cloud's id.
    notes: ClassVar[dict[str, list[str]]] = collections.defaultdict(list)
    #: Set when the launch ends; calls then raise Cancelled.
    cancel: Optional[threading.Event] = None
    #: An ``Account``, if the cloud's requests go through one.
    _account: Any = None

    @staticmethod
    def configured() -> bool:
        """Return whether the cloud is set up here; read only files and variables."""
        return True

    def until(
        self: Adapter, cancel: Optional[threading.Event], *, hasty: bool = False,
    ) -> Adapter:
        """
        Return an adapter whose calls raise Cancelled once ``cancel`` is set.

        :param cancel: None for clean-up, which continues after the launch's end.
        :param hasty: use short time-outs, for values that are only displayed.
        """
        other = copy.copy(self)
        other.cancel = cancel
        if self._account is not None:
            other._account = self._account.having(cancel, hasty=hasty)
        return other

    # -- the account ----------------------------------------------------------------------------

    def account(self: Adapter, options: Any) -> Adapter:
        """Return an adapter for the account (project, subscription) that options name."""
        return self

    @abc.abstractmethod
    def check_credentials(self) -> None:
        """
        Check that there are credentials, without a request.

        :raises PrerequisiteError: there are none, or the SDK is not installed.
        """

    @abc.abstractmethod
    def whoami(self, region: str) -> str:
        """Return the account in a few words for people; make the smallest request."""

    @abc.abstractmethod
    def default_region(self) -> str:
        """Return the region of the user's configuration, '' if there is none."""

    def enabled_regions(self) -> list[str]:
        """Return the regions that the account may use."""
        return list(self.regions.enabled)

    def searched_regions(self) -> list[str]:
        """
        Return the regions of ``find`` and ``leftovers`` if the user names none.

        [''] if one request answers for all regions; these methods then get '' as region.
        """
        return self.enabled_regions()

    # -- types and prices -----------------------------------------------------------------------

    @abc.abstractmethod
    def types(self, region: str) -> Iterable[MachineType]:
        """Return the current types of a region."""

    @abc.abstractmethod
    def prices(self, region: str, name: str = '') -> dict[str, Decimal]:
        """Return the prices on demand in US dollars per hour, by type; of one type if named."""

    def zones(self, region: str) -> dict[str, list[str]]:
        """Return the zones of a region that have each type, by type."""
        return {kind.name: [region] for kind in self.types(region)}

    def spot_prices(
        self, region: str, names: Optional[Sequence[str]],
    ) -> dict[str, dict[str, Decimal]]:
        """Return the spot prices in US dollars per hour, by type and zone; None: all types."""
        return {}

    def account_key(self) -> str:
        """Return what distinguishes this account and endpoint from others in a cache."""
        return ''

    def named_types(self, region: str, names: Sequence[str]) -> Iterable[MachineType]:
        """Return these types as far as the region has them; few requests."""
        return [kind for kind in self.types(region) if kind.name in names]

    # -- machines -------------------------------------------------------------------------------

    @abc.abstractmethod
    def find(self, region: str, tags: Mapping[str, str]) -> Iterable[Vm]:
        """Return the machines of FogROS2 that have all of ``tags``, in any state but deleted."""

    def end_hint(self, reason: str) -> str:
        """Return the remedy for a machine that ended while it was coming up."""
        return f'the console of {self.title} has its system log'

    @abc.abstractmethod
    def get(self, region: str, vm: str) -> Optional[Vm]:
        """
        Return a machine, None if it is so new that the cloud does not report it yet.

        :raises MachineNotFound: it does not exist (any more).
        """

    def is_marked(self, machine: VmId) -> bool:
        """Return whether the API announces the end of a spot machine that still runs."""
        return False

    def prepare(self, region: str, order: Order, types: Sequence[str]) -> Mapping[str, Any]:
        """
        Look up what ``insert`` needs for each type, such as the image; create nothing.

        :returns: by type; a type that the region does not have is left out.
        :raises ConfigurationError: the region has none of the types, or an option does not fit.
        """
        return dict.fromkeys(types)

    def begin(self, region: str, order: Order, created: list[str]) -> None:
        """Create what a machine needs before it (firewall, key); append ids to ``created``."""

    def undo_begin(
        self, region: str, attempt: str, created: Sequence[str],
    ) -> Iterator[tuple[str, Callable[[], object]]]:
        """Yield the steps that delete what ``begin`` created: a name for people, a function."""
        yield from ()

    def places(self, region: str, order: Order) -> Iterator[str]:
        """Yield the zones or subnets to try, '' for any; requests are made only when needed."""
        yield ''

    @abc.abstractmethod
    def insert(
        self, place: Place, order: Order, prepared: Any, created: list[str],
        tags: Mapping[str, str],
    ) -> str:
        """
        Request a machine and return the cloud's id; the same token never creates two.

        :param created: ids for ``undo_begin``; what it creates besides is added.
        :param tags: of the machine: those of the order, the host key and the price.
        :raises CloudError: with ``full`` if there is no capacity.
        """

    def end_command(self, machine: VmId, tags: Mapping[str, str]) -> tuple[str, ...]:
        """
        Return the command by which a machine with these tags ends itself and its billing, as root.

        :param machine: ``vm`` is '' in the command of the user data, which is written before the
            cloud names the machine; the launch replaces that command at its first connection.
        """
        return END_COMMAND

    @abc.abstractmethod
    def delete(self, machine: VmId) -> None:
        """Delete a machine and everything of its attempt; return when all of it is gone."""

    @abc.abstractmethod
    def end_attempt(self, region: str, attempt: str) -> bool:
        """
        Delete the machines of an attempt whose creation failed, without waiting.

        :returns: whether there was one.
        """

    @abc.abstractmethod
    def set_firewall(self, machine: VmId, port: int, sources: Sequence[str]) -> None:
        """Let only ``sources`` (CIDR) reach a TCP port of a machine; none closes it."""

    @abc.abstractmethod
    def set_tags(self, machine: VmId, tags: Mapping[str, str]) -> None:
        """Add tags to a machine, or replace them."""

    def set_ending(self, machine: VmId, spec: MachineSpec) -> None:
        """Change what happens when the machine shuts itself down (stop, or be deleted)."""

    def stop(self, machine: VmId) -> None:
        """Stop a machine and keep its disk."""
        raise Unsupported(f"a machine at {self.title} can't be stopped")

    def start(self, machine: VmId) -> None:
        """Start a stopped machine."""
        raise Unsupported(f"a machine at {self.title} can't be started")

    def remains(self, region: str) -> Iterable[Mapping[str, str]]:
        """Return the tags of what attempts have besides machines; see ``leftovers``."""
        return ()

    def attempts(self, region: str) -> Collection[str]:
        """Return the attempts that have a machine, in any state that may end."""
        return ()

    def leftovers(self, region: str, now: float, dead: Collection[str]) -> Mapping[str, str]:
        """
        Return this robot's attempts of which no machine is left, with the machine's name.

        An entry with a damaged time is left out, and a warning names it.

        :param now: seconds since the epoch; a new attempt may still get its machine.
        :param dead: attempts that get none, because their launches have died.
        """
        names: dict[str, str] = {}
        # one entry for each attempt, which may have a firewall and a key
        for attempt, tags in {tags.get(TAG_ATTEMPT, ''): tags
                              for tags in self.remains(region)}.items():
            # another robot's clock may differ, and its machine may be about to be created
            if not attempt or is_another_robot(tags.get(TAG_ROBOT, '')):
                continue
            made = made_at(tags)
            if attempt not in dead and made is None:
                _LOGGER.warning(
                    "%s: '%s' has the damaged tag %s=%.40r, and stays: %s", self.title,
                    tags.get(TAG_NAME, '?'), TAG_MADE, tags[TAG_MADE], own_name(attempt))
            elif attempt in dead or now - (made or 0.0) > SETTLED:
                names[attempt] = tags.get(TAG_NAME, '?')
        for attempt in self.attempts(region) if names else ():
            names.pop(attempt, None)
        return names

    def sweep(self, region: str, attempt: str) -> None:
        """Delete what an attempt created besides its machine."""

    # -- volumes --------------------------------------------------------------------------------

    def beside(self: Adapter, machine: VmId) -> Adapter:
        """Return an adapter for the account (project) in which a machine is."""
        return self

    def disks(self, region: str, name: str = '') -> Iterable[Disk]:
        """Return the volumes of a region, of one name if it is given."""
        return ()

    def make_disk(self, machine: VmId, name: str, size_gb: int) -> str:
        """Make a volume where a machine is; return its id, perhaps before it is ready."""
        raise Unsupported(f'FogROS2 makes no volumes at {self.title}')

    def attach_disk(self, machine: VmId, disk: Disk) -> tuple[str, ...]:
        """
        Attach a volume that the machine may have already; return paths, of which one appears.

        The machine's end leaves it.
        """
        raise Unsupported(f'FogROS2 has no volumes at {self.title}')

    def detach_disk(self, machine: VmId, disk: Disk) -> None:
        """Detach a volume."""

    def delete_disk(self, disk: Disk) -> None:
        """Delete a volume; idempotent."""
