# SPDX-License-Identifier: Apache-2.0
"""Machines and launches as the live state shows them, and their JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import dataclasses
from pathlib import Path
import time
from typing import Any, Optional, TextIO

from fogros2 import journal
from fogros2.clock import ClockOffset
from ros2fog_cli.api.follower import Follower
from ros2fog_cli.api.machines import Entry

#: The step with which a machine begins, also anew; the step after which it is up; the steps that
#: end it.
BEGIN, UP, DOWN = 'machine', 'agent', ('delete', 'stop', 'keep', 'let go')


@dataclasses.dataclass
class Shown:
    """A machine with its collected data, which stay after the machine is gone."""

    entry: Entry
    follower: Optional[Follower] = None
    steps: tuple[journal.Step, ...] = ()
    clock: Optional[ClockOffset] = None
    launch: str = ''
    ended: float = 0.0
    deleting: bool = False
    trouble: str = ''
    #: Rows of features from files of its launch, by the features' names.
    figures: dict[str, Sequence[Mapping[str, Any]]] = dataclasses.field(default_factory=dict)
    #: Why a feature has no new rows, by its name.
    unread: dict[str, str] = dataclasses.field(default_factory=dict)

    def is_of(self, entry: Entry) -> bool:
        """
        Return whether an entry of the same name is this machine.

        A robot has one record per name. An entry without an id may be a machine that is known.
        """
        recorded = [one for one in (self.entry, entry) if one.record is not None]
        return (len(recorded) == 2 or any(one.machine_id is None for one in recorded)
                or self.entry.machine_id == entry.machine_id)


@dataclasses.dataclass
class ShownLaunch:
    """A launch: its process and its steps."""

    pid: int = 0
    alive: bool = True
    #: The open journal: the launch deletes its folder, and the last lines must still be readable.
    file: Optional[TextIO] = None
    #: The beginning of a line that is not complete yet.
    rest: str = ''
    contents: journal.Contents = dataclasses.field(default_factory=journal.Contents)
    ended: float = 0.0

    def read(self, folder: Path) -> None:
        """Read the new lines of the journal."""
        with contextlib.suppress(OSError):  # there is no journal yet
            if self.file is None:
                self.file = open(folder / journal.FILE, errors='replace')
            *lines, self.rest = (self.rest + self.file.read()).split('\n')
            for line in lines:
                self.contents.add(line)

    def close(self) -> None:
        """Close the journal."""
        if self.file is not None:
            self.file.close()
            self.file = None


def machine_json(key: str, shown: Shown) -> dict[str, Any]:
    """
    Return a machine as JSON values: times in seconds since the epoch, money in US dollars.

    :param key: identifies the machine among others of the same name.
    """
    entry, follower, record = shown.entry, shown.follower, shown.entry.record
    agent = follower.agent if follower is not None else None
    steps = [as_json(step, ended=bool(shown.ended)) for step in shown.steps]
    return {
        'key': key, 'name': entry.name, 'provider': entry.provider, 'id': entry.machine_id,
        'state': 'gone' if shown.ended else entry.state, 'phase': _phase(shown),
        'launch': shown.launch,
        'launch_pid': record.pid if record is not None and record.launch_alive else 0,
        'launch_alive': record is not None and record.launch_alive and not shown.ended,
        'created': entry.created, 'expires': entry.expires, 'ended': shown.ended or None,
        'address': entry.address, 'place': entry.known.region, 'kind': entry.known.kind,
        'cost_per_hour': None if entry.cost is None else float(entry.cost),
        'on_exit': record.spec.on_exit if record is not None else '',
        **entry.notes,
        'steps': steps,
        'vpn': _vpn(follower.vpn) if follower is not None else None,
        'clock': None if follower is None or shown.clock is None
        else {**dataclasses.asdict(shown.clock), 'text': str(shown.clock)},
        'agent': None if agent is None else {
            'since': agent['since'], 'rss': 1000 * agent['rss_kb'],
            'heartbeat_age': agent['heartbeat_age']},
        'nodes': [] if agent is None else [{
            'name': node['name'], 'state': node['state'], 'pid': node['pid'] or 0,
            'returncode': node['returncode'], 'restarts': node['restarts'],
            'error': node.get('error', '')} for node in agent['nodes']],
        **shown.figures,
        'problems': [f'{part}: {text}' for part, text in sorted(
            {**shown.unread, **(follower.problems if follower is not None else {})}.items())],
        'log': follower.last if follower is not None else 0,
        'deleting': shown.deleting, 'trouble': shown.trouble,
    }


def _vpn(vpn: Optional[Mapping[str, Any]]) -> Optional[dict[str, Any]]:
    if vpn is None:
        return None
    age = vpn['handshake_age']
    return {**{key: vpn[key] for key in (
        'address', 'interface', 'received', 'sent', 'latency', 'receiving', 'sending')},
        'handshake': None if age is None else round(time.time() - age)}


def as_json(step: journal.Step, *, ended: bool = False) -> dict[str, Any]:
    """
    Return a step as JSON values.

    :param ended: whether the launch is over; a running step then counts as done.
    """
    state = 'done' if ended and step.state == 'running' else step.state
    return {**dataclasses.asdict(step), 'state': state}


def phase(steps: tuple[journal.Step, ...]) -> str:
    """Return the phase of a machine by its steps: 'coming', 'running' or 'ending'."""
    result = 'coming'
    for step in steps:
        if step.step == BEGIN:
            result = 'coming'
        if step.step in DOWN or (
                step.state == 'failed' and step.fatal and result == 'coming'):
            result = 'ending'
        elif step.step == UP and step.state == 'done':
            result = 'running'
    return result


def _phase(shown: Shown) -> str:
    record = shown.entry.record
    if shown.ended:
        return 'gone'
    if shown.deleting:
        return 'ending'
    if record is not None and record.launch_alive:
        return phase(shown.steps) if shown.steps or not record.agent else 'running'
    return shown.entry.state.partition(' ')[0]
