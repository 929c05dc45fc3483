# SPDX-License-Identifier: Apache-2.0
"""List machines: from the providers, or from the store where a provider cannot list them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import contextlib
import dataclasses
from decimal import Decimal
import threading
import time
from typing import Any, NamedTuple, Optional, TypeVar

from fogros2 import feature, plugin_system
from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    did_you_mean,
    FogError,
    MachineNotFound,
    Unsupported,
)
from fogros2.model import Machine, MachineState
from fogros2.provider import Provider, TAG_EXPIRES, TAG_LAUNCH, TAG_NAME, TAG_ROBOT
from fogros2.store import is_another_robot, Record, Store
from ros2fog_cli.api.interrupts import interruptible

Warn = Callable[[str], None]
T = TypeVar('T')
#: Seconds by which the robot's clock may be behind the provider's.
CLOCK_TOLERANCE = 86400.0
#: Stands for a machine that its provider does not know, or that nobody has asked for.
_UNKNOWN = Machine('', '', '', MachineState.DELETED)


@dataclasses.dataclass(frozen=True)
class Entry:
    """
    A machine as its provider and this robot know it.

    :param machine: None if the provider does not know the machine or could not be asked.
    :param record: None if this robot has no record: an orphan, or another robot's machine.
    :param asked: whether ``machine`` is the provider's answer.
    """

    name: str
    provider: str
    machine: Optional[Machine] = None
    record: Optional[Record] = None
    asked: bool = True

    @property
    def known(self) -> Machine:
        """The provider's answer; a deleted machine without one."""
        return self.machine or _UNKNOWN

    @property
    def gone(self) -> bool:
        """Whether the provider no longer knows the machine, or reports it as deleted."""
        return self.asked and self.known.state is MachineState.DELETED and not self.requested

    @property
    def requested(self) -> bool:
        """Whether a launch is creating the machine, and has no id of it yet."""
        return self.machine is None and self.record is not None \
            and self.record.machine_id is None and self.record.launch_alive

    @property
    def state(self) -> str:
        """The state as text for users."""
        if self.record is not None and self.record.damage:
            state = self.machine.state if self.machine is not None else 'unknown'
            return f'{state} (record damaged)'
        if not self.asked:
            return 'unknown'
        if self.gone:
            return 'gone'
        if self.requested:
            return str(MachineState.PENDING)
        text = str(self.known.state)
        if self.known.state is MachineState.STOPPED:
            if not self.known.owned:
                return 'unknown (does not answer)'
            return f"{text} ({'still billed' if self.known.billed else 'keeps its disk'})"
        if self.record is None:
            return f'{text} (orphan)' if self.own else f'{text} (robot {self.robot})'
        if self.record.launch and not self.record.launch_alive:
            return f'{text} (launch gone)'
        return text

    @property
    def robot(self) -> str:
        """The robot that created the machine, '' if unknown."""
        noted = '' if self.record is None else self.record.robot
        return self.known.tags.get(TAG_ROBOT, noted)

    @property
    def own(self) -> bool:
        """Whether the machine belongs to this robot."""
        return not is_another_robot(self.robot)

    @property
    def created(self) -> Optional[float]:
        """When the machine was created, in seconds since the epoch."""
        return self.known.created or (
            self.record.created or None if self.record is not None else None)

    @property
    def expires(self) -> Optional[float]:
        """When the lifetime ends, in seconds since the epoch; None for a stopped machine."""
        if self.known.state is MachineState.STOPPED:
            return None
        tag = self.known.tags.get(TAG_EXPIRES, '')
        ends = [float(tag)] if tag.isdecimal() and len(tag) < 13 else []
        record = self.record
        if record is not None and record.armed:
            # A launch may have reused the machine, or shortened the lifetime, since the creation.
            ends = [max(record.armed, record.earliest) + record.spec.lifetime]
        # a robot whose clock is wrong may note an end that is long before the beginning
        begin = (self.known.created or 0.0) - CLOCK_TOLERANCE
        return max((at for at in ends if at > begin), default=None)

    @property
    def address(self) -> str:
        """The host of the machine's endpoint, '' if there is none."""
        endpoint = self.known.endpoint or (self.record and self.record.endpoint)
        return endpoint.host if endpoint else ''

    @property
    def notes(self) -> dict[str, Optional[str]]:
        """What features have noted of the machine while its launch runs, by name."""
        alive = self.record is not None and self.record.launch_alive
        return {key: self.record.notes.get(key) if alive and self.record else None
                for key in notes()}

    @property
    def launch(self) -> str:
        """The launch that uses the machine, or used it last."""
        if self.record is not None and self.record.launch:
            return self.record.launch
        return self.known.tags.get(TAG_LAUNCH, '')

    @property
    def cost(self) -> Optional[Decimal]:
        """US dollars per hour; None if the machine does not run or its price is unknown."""
        return self.known.cost_per_hour if self.runs else None

    @property
    def runs(self) -> bool:
        """Whether the provider bills the machine as a running one."""
        return self.known.owned and (self.known.billed or self.known.state in (
            MachineState.PENDING, MachineState.RUNNING, MachineState.STOPPING))

    def spent(self, now: float) -> Optional[Decimal]:
        """Return the US dollars since the creation at today's price, None if unknown."""
        rate = self.cost
        if rate is None or self.created is None:
            return None
        return rate * Decimal(max(0.0, now - self.created)) / 3600

    @property
    def machine_id(self) -> Optional[str]:
        """The id of the machine at its provider."""
        if self.machine is not None:
            return self.machine.id
        return self.record.machine_id if self.record is not None else None

    def to_json(self, now: Optional[float] = None) -> dict[str, Any]:
        """Return the entry as JSON values: times in seconds, money in US dollars."""
        now = time.time() if now is None else now
        return {
            'name': self.name, 'provider': self.provider, 'state': self.state,
            'id': self.machine_id, 'robot': self.robot, 'launch': self.launch,
            'launch_alive': self.record.launch_alive if self.record is not None else None,
            'created': self.created,
            'age': None if self.created is None else max(0.0, now - self.created),
            'address': self.address,
            'host_key': self.known.endpoint.host_key or None if self.known.endpoint else None,
            'expires': self.expires,
            'time_left': None if self.expires is None else self.expires - now,
            'place': self.known.region, 'kind': self.known.kind,
            'image': self.known.image or None, 'key': self.known.key or None,
            'disk_gb': self.known.disk_gb,
            **self.notes,
            'cost_per_hour': None if self.cost is None else float(self.cost),
            'cost': None if (spent := self.spent(now)) is None else round(float(spent), 6),
        }


def notes(warn: Warn = lambda text: None) -> dict[str, str]:
    """
    Return what features may note of machines, each with its line for ``ros2 fog list``.

    :param warn: takes a line about each feature that cannot be loaded.
    """
    return {key: line for each in feature.loadable(warn).values()
            for key, line in each.notes.items()}


class Answer(NamedTuple):
    """
    What a provider answered.

    :param silent: records whose machines it could not be asked about, such as those on a host
        that is off.
    """

    machines: list[Machine]
    silent: Sequence[str] = ()


def survey(
    warn: Warn, *, name: Optional[str] = None, regions: Optional[Sequence[str]] = None,
    store: Optional[Store] = None,
) -> list[Entry]:
    """
    Return all machines, or those named ``name``, by all providers; Ctrl-C ends the search.

    :param regions: regions to search; providers with regions are then always asked.
    """
    records = recorded(store or Store(), name)
    with interruptible() as given_up:
        return combined(records, answers(warn, records, name, regions, given_up))


def recorded(store: Store, name: Optional[str] = None) -> dict[str, Record]:
    """Return all records by their names, or the one named ``name``."""
    return {record.name: record for record in store.machines() if name in (None, record.name)}


def answers(
    warn: Warn, records: Mapping[str, Record], name: Optional[str],
    regions: Optional[Sequence[str]], cancel: threading.Event,
) -> dict[str, Optional[Answer]]:
    """
    Return each provider's machines, or those named ``name``; ask all in parallel.

    If a provider cannot be asked (no SDK, no credentials, no engine), warn, and return None for
    it. Skip a provider that is not configured here and that no record names: loading its SDK takes
    longer than the answers of all others.
    """
    tags = {} if name is None else {TAG_NAME: name}
    providers = plugin_system.names('fogros2.provider')
    return dict(zip(providers, ask_all(warn, providers, lambda provider: _ask(
        warn, provider, tags, regions, records.values(), cancel))))


def combined(
    records: Mapping[str, Record], answers: Mapping[str, Optional[Answer]],
) -> list[Entry]:
    """Return the machines that the store or a provider knows."""
    entries: list[Entry] = []
    matched: set[str] = set()
    for answer in answers.values():
        for machine in answer.machines if answer else []:
            record = record_of(machine, records)
            if record is not None:
                matched.add(record.name)
            entries.append(Entry(machine.name or machine.tags.get(TAG_NAME, ''),
                                 machine.provider, machine, record))
    for record in records.values():
        if record.name not in matched:
            reply = answers.get(record.provider)
            is_known = reply is not None and record.name not in reply.silent or bool(record.damage)
            entries.append(Entry(record.name, record.provider or '?', None, record, is_known))
    return sorted(entries, key=lambda entry: (entry.name, entry.provider))


def ask_all(
    warn: Warn, providers: Sequence[str], ask: Callable[[str], T],
) -> list[Optional[T]]:
    """Return ``ask(name)`` for each provider, None where that failed; ask them in parallel."""
    def answer(name: str) -> Optional[T]:
        try:
            return ask(name)
        except (Cancelled, Unsupported):
            return None  # Ctrl-C ends the whole program
        except Exception as error:  # noqa: BLE001 - a plugin's defect must not hide the others
            warn(f'{name}: {plugin_system.cause(error)}')
            return None

    with ThreadPoolExecutor(max(1, len(providers)), 'fog-ask') as pool:
        return list(pool.map(answer, providers))


def gather(
    warn: Warn, regions: Optional[Sequence[str]], ask: Callable[[str], Iterable[T]],
) -> list[T]:
    """Return what ``ask(name)`` yields for all providers that are configured here."""
    found: dict[str, list[T]] = {name: [] for name in plugin_system.names('fogros2.provider')
                                 if wanted(name, regions)}
    # one that fails has answered in part, perhaps
    ask_all(warn, [*found], lambda name: found[name].extend(ask(name)))
    return [each for answer in found.values() for each in answer]


def wanted(name: str, regions: Optional[Sequence[str]]) -> bool:
    """Return whether to ask a provider that no record of this robot names."""
    try:
        if not regions and name in plugin_system.names('fogros2.configured'):
            # This entry point answers without loading the provider, which takes long.
            return bool(plugin_system.load('fogros2.configured', name)())
        kind: type[Provider] = plugin_system.load('fogros2.provider', name)
        return kind.configured() or bool(regions) and kind.capabilities.regions
    except Exception:  # noqa: BLE001 - the caller asks it, and reports the error with its name
        return True


def record_of(machine: Machine, records: Mapping[str, Record]) -> Optional[Record]:
    """Return this robot's record of a machine, None for another robot's machine of that name."""
    record = records.get(machine.name or machine.tags.get(TAG_NAME, ''))
    if record is None:
        return None
    if record.damage:
        return record if Entry('', '', machine).own else None
    if record.machine_id is None:
        # the launch was killed after the provider had created the machine, before it saved the id
        launch = machine.tags.get(TAG_LAUNCH)
        return record if launch and launch in (record.launch, record.last) else None
    return record if record.machine_id == machine.id else None


def _ask(
    warn: Warn, name: str, tags: Mapping[str, str], regions: Optional[Sequence[str]],
    records: Iterable[Record], cancel: threading.Event,
) -> Answer:
    """
    Return a provider's machines.

    :raises FogError: the provider can't be asked, about none of its machines.
    """
    records = [record for record in records if record.provider == name]
    if not records and not wanted(name, regions):
        return Answer([])
    provider = load(name, regions, records)
    provider.cancel = cancel
    matches: list[Machine] = []
    failure: Optional[FogError] = None
    try:
        for machine in provider.find(tags):
            matches.append(machine)
    except Unsupported:
        pass
    except FogError as error:
        if not matches and not any(record.machine_id for record in records):
            raise
        failure = error  # such as one of several hosts or regions
        warn(f'{name}: {error}')

    def look(record: Record) -> bool:
        """Add a recorded machine, if it exists; return whether this is known."""
        try:
            if record.machine_id:
                matches.append(provider.describe(record.machine_id))
            # without an id, the machine may be where nobody answered
            return bool(record.machine_id) or failure is None
        except MachineNotFound:
            return True
        except FogError as error:
            if failure is None:
                warn(f'{name}: {error}')
            return False

    # it may have no tags, or not be able to search where the machine is
    ids = {machine.id for machine in matches}
    others = [record for record in records if record.machine_id not in ids]
    with ThreadPoolExecutor(16, 'fog-ask') as pool:
        known = list(pool.map(look, others))
    return Answer(matches, [record.name for record, sure in zip(others, known) if not sure])


def load(
    name: str, regions: Optional[Sequence[str]] = None, records: Iterable[Record] = (),
) -> Provider:
    """
    Load a provider.

    :param regions: regions to search if the provider has regions; ``['all']`` or ``['*']``: all.
    :param records: of machines to search for; those of other providers are ignored.
    :raises FogError: no provider has that name, or a library of the provider is not installed.
    """
    provider: Provider = plugin_system.load('fogros2.provider', name)()
    if regions:
        provider.search_in(['all'] if {'all', '*'} & set(regions) else list(regions))
    provider.search_for(record.spec for record in records if record.provider == name)
    return provider


def able(capability: str) -> str:
    """
    Return the first provider with a capability; one that is set up here comes first.

    :param capability: a field of :class:`~fogros2.provider.Capabilities`.
    :raises ConfigurationError: no provider has it.
    """
    candidates: list[tuple[bool, str]] = []
    for name in plugin_system.names('fogros2.provider'):
        with contextlib.suppress(FogError):
            kind: type[Provider] = plugin_system.load('fogros2.provider', name)
            if getattr(kind.capabilities, capability):
                candidates.append((not kind.configured(), name))
    if not candidates:
        raise ConfigurationError(f'no provider here has {capability}',
                                 'pip list shows whether the plugin of one is installed')
    return min(candidates)[1]


def total(entries: Sequence[Entry], now: float) -> Optional[tuple[Decimal, Decimal]]:
    """Return the US dollars per hour and so far of all machines with a known price, or None."""
    rates = [entry.cost for entry in entries if entry.cost is not None]
    if not rates:
        return None
    return sum(rates, Decimal(0)), sum((entry.spent(now) or Decimal(0) for entry in entries),
                                       Decimal(0))


def unknown(name: str, store: Optional[Store] = None) -> ConfigurationError:
    """Return the error for a machine that nobody knows; its hint is the nearest name."""
    names = [record.name for record in (store or Store()).machines()]
    return ConfigurationError(f"there is no machine '{name}'", did_you_mean(
        name, names, 'ros2 fog list shows those there are'))


def one(entries: Sequence[Entry], name: str) -> Entry:
    """
    Return the one machine of that name.

    :raises ConfigurationError: no machine, or several machines have that name.
    """
    own = [entry for entry in entries if entry.own] or list(entries)
    if not own:
        raise unknown(name)
    if len(own) > 1:
        places = ', '.join(f'{entry.provider} {entry.machine_id}' for entry in own)
        raise ConfigurationError(f"there are several machines '{name}': {places}",
                                 'ros2 fog list shows whose they are')
    return own[0]
