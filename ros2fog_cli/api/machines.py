# SPDX-License-Identifier: Apache-2.0
"""Which machines there are: the providers' word first, the store's where a provider has none."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import contextlib
import dataclasses
from decimal import Decimal
import threading
import time
from typing import Any, Optional, Protocol, runtime_checkable

from fogros2 import monitor_addresses, plugin_system
from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    FogError,
    MachineNotFound,
    Unsupported,
)
from fogros2.model import Machine, MachineState
from fogros2.provider import Provider, TAG_EXPIRES, TAG_LAUNCH, TAG_NAME, TAG_ROBOT
from fogros2.store import Record, robot_name, Store
from ros2fog_cli.api.interrupts import interruptible

Warn = Callable[[str], None]


@runtime_checkable
class HasRegions(Protocol):
    """A provider whose machines are in regions."""

    def set_regions(self, regions: Sequence[str]) -> None:
        """Ask these regions from now on; ``['all']`` stands for every one."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """
    A machine as the provider and this robot know it.

    :param machine: None where the provider doesn't know it (any more), or can't be asked.
    :param record: None where this robot knows nothing of it: an orphan, or another robot's.
    :param asked: whether the provider's answer is in ``machine``.
    """

    name: str
    provider: str
    machine: Optional[Machine] = None
    record: Optional[Record] = None
    asked: bool = True

    @property
    def gone(self) -> bool:
        """Whether only this robot's record is left of it."""
        return self.asked and (self.machine is None
                               or self.machine.state is MachineState.DELETED)

    @property
    def state(self) -> str:
        """The state in words for people."""
        if self.record is not None and self.record.damage:
            state = self.machine.state if self.machine is not None else 'unknown'
            return f'{state} (record damaged)'
        if not self.asked:
            return 'unknown'
        if self.machine is None or self.gone:
            return 'gone'
        text = str(self.machine.state)
        if self.machine.state is MachineState.STOPPED:
            return f'{text} (keeps its disk)'
        if self.record is None:
            return f'{text} (orphan)' if self.own else f'{text} (robot {self.robot})'
        if self.record.launch and not self.record.launch_alive:
            return f'{text} (launch gone)'
        return text

    @property
    def robot(self) -> str:
        """The robot that asked for it, '' where nobody knows."""
        if self.machine is not None and TAG_ROBOT in self.machine.tags:
            return self.machine.tags[TAG_ROBOT]
        return robot_name() if self.record is not None else ''

    @property
    def own(self) -> bool:
        """Whether it is this robot's."""
        return self.robot in ('', robot_name())

    @property
    def created(self) -> Optional[float]:
        """When it was made, in seconds since the epoch."""
        if self.machine is not None and self.machine.created:
            return self.machine.created
        return self.record.created or None if self.record is not None else None

    @property
    def expires(self) -> Optional[float]:
        """When its lifetime is over, in seconds since the epoch; a stopped one's begins anew."""
        if self.machine is not None and self.machine.state is MachineState.STOPPED:
            return None
        tag = self.machine.tags.get(TAG_EXPIRES, '') if self.machine is not None else ''
        known = [float(tag)] if tag.isdigit() else []
        record = self.record
        if record is not None and record.armed:
            # later than the tag, which was set at the creation, where a launch reused it
            known.append(record.armed + record.spec.lifetime)
        elif record is not None and record.created and not known:
            known.append(record.created + record.spec.lifetime)
        return max(known, default=None)

    @property
    def address(self) -> str:
        """Where its shell is, '' while there is none."""
        if self.machine is not None and self.machine.shell is not None:
            return self.machine.shell.host
        return self.record.shell.host if self.record is not None and self.record.shell else ''

    @property
    def monitor(self) -> str:
        """Where this robot sees its topics, with a token; '' while it serves none."""
        record = self.record
        if record is None or not record.monitor or record.vpn is None or not record.launch_alive:
            return ''
        return monitor_addresses.bridge(record.vpn.address, record.monitor)

    @property
    def launch(self) -> str:
        """The launch that has it, or had it last."""
        if self.record is not None and self.record.launch:
            return self.record.launch
        return self.machine.tags.get(TAG_LAUNCH, '') if self.machine is not None else ''

    @property
    def cost(self) -> Optional[Decimal]:
        """US dollars an hour while it runs; nothing once it has ended; None where unknown."""
        if self.machine is None or self.machine.state not in (
                MachineState.PENDING, MachineState.RUNNING, MachineState.STOPPING):
            return None
        return self.machine.cost_per_hour

    def spent(self, now: float) -> Optional[Decimal]:
        """Return the US dollars since its creation at today's price, None where unknown."""
        rate = self.cost
        if rate is None or self.created is None:
            return None
        return rate * Decimal(max(0.0, now - self.created)) / 3600

    @property
    def place(self) -> str:
        """Region, context, engine: '' where the provider names none."""
        return self.machine.place if self.machine is not None else ''

    @property
    def kind(self) -> str:
        """What it is, such as an instance type; '' where the provider names none."""
        return self.machine.kind if self.machine is not None else ''

    @property
    def machine_id(self) -> Optional[str]:
        """The provider's id."""
        if self.machine is not None:
            return self.machine.id
        return self.record.machine_id if self.record is not None else None

    def to_json(self, now: Optional[float] = None) -> dict[str, Any]:
        """Return it as JSON: times in seconds, money in US dollars as a string."""
        now = time.time() if now is None else now
        return {
            'name': self.name, 'provider': self.provider, 'state': self.state,
            'id': self.machine_id, 'robot': self.robot, 'launch': self.launch,
            'launch_alive': self.record.launch_alive if self.record is not None else None,
            'created': self.created,
            'age': None if self.created is None else max(0.0, now - self.created),
            'address': self.address, 'expires': self.expires,
            'time_left': None if self.expires is None else self.expires - now,
            'place': self.place, 'kind': self.kind,
            'image': self.machine.image or None if self.machine is not None else None,
            'key': self.machine.key or None if self.machine is not None else None,
            'disk_gb': self.machine.disk_gb if self.machine is not None else None,
            'monitor': self.monitor or None,
            'monitor_open': self.record.monitor_open or None
            if self.record is not None and self.monitor else None,
            'cost_per_hour': None if self.cost is None else str(self.cost),
            'cost': None if (spent := self.spent(now)) is None
            else str(spent.quantize(Decimal('0.000001'))),
        }


def survey(
    warn: Warn, *, name: Optional[str] = None, regions: Optional[Sequence[str]] = None,
    store: Optional[Store] = None, cancel: Optional[threading.Event] = None,
) -> list[Entry]:
    """
    Return all machines, or those called ``name``, asking all providers at once.

    A provider that can't be asked (no SDK, no credentials, no engine) costs a warning; what the
    store knows of its machines is returned all the same. One that nobody has set up here, and
    that no record names, is left out: its SDK takes longer to load than all others to answer.

    :param regions: places to ask; a provider that has places is asked then in any case.
    :param cancel: set to give up; by a Ctrl-C where it is left out.
    """
    records = {record.name: record for record in (store or Store()).machines()}
    if name is not None:
        records = {key: value for key, value in records.items() if key == name}
    tags = {} if name is None else {TAG_NAME: name}
    providers = plugin_system.names('fogros2.provider')
    with contextlib.nullcontext(cancel) if cancel is not None else interruptible() as given_up, \
            ThreadPoolExecutor(max(1, len(providers)), 'fog-list') as pool:
        answers = list(pool.map(lambda provider: _ask(
            provider, tags, regions, records.values(), warn, given_up), providers))
    entries: list[Entry] = []
    matched: set[str] = set()
    for machines in answers:
        for machine in machines or []:
            record = _record_of(machine, records)
            if record is not None:
                matched.add(record.name)
            entries.append(Entry(machine.name or machine.tags.get(TAG_NAME, ''),
                                 machine.provider, machine, record))
    asked = {provider for provider, answer in zip(providers, answers) if answer is not None}
    for record in records.values():
        if record.name not in matched:
            known = record.provider in asked or bool(record.damage)
            entries.append(Entry(record.name, record.provider or '?', None, record, known))
    return sorted(entries, key=lambda entry: (entry.name, entry.provider))


def wanted(name: str, regions: Optional[Sequence[str]]) -> bool:
    """Return whether to ask a provider of whose machines this robot has no record."""
    if not regions and name in plugin_system.names('fogros2.configured'):
        # what says so without loading the provider, which takes as long as all the others' answers
        return bool(plugin_system.load('fogros2.configured', name)())
    try:
        kind: type[Provider] = plugin_system.load('fogros2.provider', name)
    except FogError:
        return True  # reported with its name, as any other failure
    return kind.configured() or bool(regions) and issubclass(kind, HasRegions)


def _record_of(machine: Machine, records: Mapping[str, Record]) -> Optional[Record]:
    """Return this robot's record of a machine; another robot's of the same name is not it."""
    record = records.get(machine.name or machine.tags.get(TAG_NAME, ''))
    if record is None:
        return None
    if record.damage:
        return record if machine.tags.get(TAG_ROBOT, robot_name()) == robot_name() else None
    return record if record.machine_id == machine.id else None


def _ask(
    name: str, tags: Mapping[str, str], regions: Optional[Sequence[str]],
    records: Iterable[Record], warn: Warn, cancel: threading.Event,
) -> Optional[list[Machine]]:
    """Return a provider's machines, None if it can't be asked."""
    try:
        if not any(record.provider == name for record in records) and not wanted(name, regions):
            return []
        provider = load(name, regions)
        provider.cancel = cancel
        try:
            return list(provider.find(tags))
        except Unsupported:
            return _described(provider, [r for r in records if r.provider == name])
    except Cancelled:
        return None  # by a Ctrl-C, which ends everything
    except FogError as error:
        warn(f'{name}: {error}')
        return None


def _described(provider: Provider, records: Sequence[Record]) -> list[Machine]:
    """Return the machines that the store knows, of a provider that keeps no tags."""
    machines = []
    for record in records:
        if record.machine_id is not None:
            try:
                machines.append(provider.describe(record.machine_id))
            except MachineNotFound:
                continue
    return machines


def load(name: str, regions: Optional[Sequence[str]] = None) -> Provider:
    """
    Return a provider.

    :param regions: asked where the provider has any, ``['all']`` or ``['*']`` for every one.
    :raises FogError: there is none, or what it needs isn't installed.
    """
    provider: Provider = plugin_system.load('fogros2.provider', name)()
    if regions and isinstance(provider, HasRegions):
        provider.set_regions(['all'] if {'all', '*'} & set(regions) else list(regions))
    return provider


def total(entries: Sequence[Entry], now: float) -> Optional[tuple[Decimal, Decimal]]:
    """Return US dollars an hour and so far, of the machines whose price is known, or None."""
    rates = [entry.cost for entry in entries if entry.cost is not None]
    if not rates:
        return None
    return sum(rates, Decimal(0)), sum((entry.spent(now) or Decimal(0) for entry in entries),
                                       Decimal(0))


def one(entries: Sequence[Entry], name: str) -> Entry:
    """
    Return the one machine of that name.

    :raises ConfigurationError: there is none, or several robots have one.
    """
    own = [entry for entry in entries if entry.own] or list(entries)
    if not own:
        raise ConfigurationError(f"there is no machine '{name}'",
                                 'ros2 fog list shows those there are')
    if len(own) > 1:
        places = ', '.join(f'{entry.provider} {entry.machine_id}' for entry in own)
        raise ConfigurationError(f"there are several machines '{name}': {places}",
                                 'ros2 fog list shows whose they are')
    return own[0]
