# SPDX-License-Identifier: Apache-2.0
"""
Keep a live state of this robot's launches, machines, steps, nodes, VPN links and topics.

``ros2 fog status --watch`` prints the state, ``ros2 fog dashboard`` serves it. While nobody
watches, no provider and no agent is polled, and no launch is joined.
"""

from __future__ import annotations

import dataclasses
import json
import threading
import time
from typing import Any, Optional

from fogros2 import feature, plugin_system
from fogros2.errors import FogError, MachineNotFound
from fogros2.store import launch_process, robot_name, Store
from ros2fog_cli.api import endings, machines
from ros2fog_cli.api.follower import Follower
from ros2fog_cli.api.graphs import Graphs
from ros2fog_cli.api.machines import Entry
from ros2fog_cli.api.shown import as_json, machine_json, phase, Shown, ShownLaunch

#: Seconds between two reads of the store (LOOK), between two polls of the providers with machines
#: (ASK) and without (ASK_SELDOM), and for which a reader of the state counts as present (PRESENT).
LOOK, ASK, ASK_SELDOM, PRESENT = 0.25, 15.0, 60.0, 20.0
#: Seconds for which machines that are gone and launches that ended are still shown.
KEPT = 900.0


class Live:
    """
    The live state, updated by threads that :meth:`start` starts and :meth:`close` ends.

    :param name: name of the one machine to watch; None: all machines.
    :param regions: regions to ask, for providers with regions.
    :param topics: whether to join launches and measure the rates of topics.
    :param pictures: with ``topics``: whether to take pictures of streams, too.
    """

    def __init__(
        self, *, name: Optional[str] = None,
        regions: Optional[list[str]] = None, topics: bool = False, pictures: bool = False,
    ) -> None:
        self.store = Store()
        self._name, self._regions = name, regions
        self._graphs = Graphs(self.store, pictures=pictures) if topics else None
        self._tables = feature.tables()
        #: Machines by their keys, see :meth:`_key`.
        self._shown: dict[str, Shown] = {}
        self._launches: dict[str, ShownLaunch] = {}
        self._warnings: list[str] = []
        self._asked = -1e9
        #: Names and ids of records, at the last look and when the providers were asked.
        self._known: set[tuple[str, Optional[str]]] = set()
        self._answered = self._known
        self._answers: dict[str, Optional[machines.Answer]] = {}
        self._lock = threading.RLock()
        self._news = threading.Condition(self._lock)
        self._wake, self._stopped = threading.Event(), threading.Event()
        self._version, self._last = 0, ''
        self._state: dict[str, Any] = {'version': 0}
        self._looked = -1e9
        self._deleting: list[threading.Thread] = []
        self._threads = [
            threading.Thread(target=self._keep, name='fog-live', daemon=True),
            threading.Thread(target=self._keep_asking, name='fog-live-ask', daemon=True)]

    def start(self) -> None:
        """Start the threads."""
        self.present()
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Wait for deletions in progress, then end the threads and the connections."""
        for thread in self._deleting:
            thread.join()
        self._stopped.set()
        self._wake.set()
        with self._lock:
            followers = [shown.follower for shown in self._shown.values() if shown.follower]
            self._news.notify_all()
        for follower in followers:
            follower.stop()
        for follower in followers:
            follower.join(2.0)
        self._threads[0].join(5.0)
        for launch in self._launches.values():
            launch.close()
        if self._graphs is not None:
            self._graphs.close()

    # -- for readers of the state ---------------------------------------------------------------

    def present(self) -> None:
        """Record that somebody watches; resume the polling if nobody did."""
        away = not self.watched
        self._looked = time.monotonic()
        if away:
            self._wake.set()

    @property
    def watched(self) -> bool:
        """Whether somebody has read the state in the last ``PRESENT`` seconds."""
        return time.monotonic() - self._looked < PRESENT

    def state(self, after: int = -1, timeout: float = 0.0) -> dict[str, Any]:
        """
        Return the state as JSON values; wait for one that is newer than ``after``.

        :param timeout: seconds after which the unchanged state is returned.
        """
        self.present()
        with self._news:
            self._news.wait_for(
                lambda: self._version > after or self._stopped.is_set(), timeout)
            return {**self._state, 'now': time.time()}

    def log(self, machine: str, after: int) -> list[dict[str, Any]]:
        """Return the lines of a machine's log after line number ``after``, as JSON values."""
        with self._lock:
            shown = self._shown.get(machine)
        return shown.follower.lines(after) if shown and shown.follower else []

    def picture(self, stream: str) -> Optional[bytes]:
        """Return the last picture of a stream, by the stream's id."""
        return self._graphs.picture(stream) if self._graphs is not None else None

    def delete(self, key: str, force: bool = False) -> None:
        """
        Start to delete a machine; the state shows the result.

        :raises FogError: no machine has that key, or a launch uses it and ``force`` is False.
        """
        with self._lock:
            shown = self._shown.get(key)
            if shown is None or shown.ended:
                raise MachineNotFound(key)
            if shown.deleting:
                return
            endings.check_free(shown.entry, force=force)
            shown.deleting, shown.trouble = True, ''
        thread = threading.Thread(target=self._delete, args=(shown, force),
                                  name='fog-live-delete', daemon=True)
        self._deleting.append(thread)
        thread.start()

    def _delete(self, shown: Shown, force: bool) -> None:
        try:
            # Ask the provider again: the shown entry may be out of date.
            for entry in machines.survey(lambda text: None, name=shown.entry.name,
                                         regions=self._regions, store=self.store):
                if entry.own and shown.is_of(entry):
                    endings.delete(entry, self.store, lambda event: None, force=force)
        except FogError as error:
            shown.trouble = str(error)
        finally:
            shown.deleting = False
            self._asked = -1e9
            self._wake.set()

    # -- the threads ----------------------------------------------------------------------------

    def _keep(self) -> None:
        while not self._stopped.is_set():
            self._wake.clear()
            self._look()
            # While nobody watches, the measurements are stopped; present() wakes this thread.
            self._wake.wait(LOOK if self.watched else None)

    def _keep_asking(self) -> None:
        while not self._stopped.wait(LOOK):
            if self.watched and time.monotonic() - self._asked >= (
                    ASK if self._shown else ASK_SELDOM):
                self._asked = time.monotonic()
                warnings: list[str] = []
                records = machines.recorded(self.store, self._name)
                answers = machines.answers(
                    warnings.append, records, self._name, self._regions, self._stopped)
                with self._lock:
                    self._answers, self._warnings = answers, warnings
                    self._answered = {
                        (record.name, record.machine_id) for record in records.values()}
                self._wake.set()

    def _look(self) -> None:
        """Update the state from the store, and wake the readers if the state changed."""
        now = time.time()
        with self._lock:
            self._look_at_launches(now)
            keys = set()
            for entry in self._found():
                key = self._key(entry)
                shown = self._shown.setdefault(key, Shown(entry))
                shown.entry, shown.ended = entry, 0.0
                keys.add(key)
            for key, shown in list(self._shown.items()):
                self._update(shown, now, is_present=key in keys)
                if shown.ended and now - shown.ended > KEPT:
                    del self._shown[key]
            state = self._make()
            followed = [(shown.entry.record, shown.follower.names)
                        for shown in self._shown.values()
                        if shown.follower is not None and shown.entry.record is not None]
        if self._graphs is not None:
            state.update(self._graphs.update(followed if self.watched else []))
        text = json.dumps(state, sort_keys=True)
        with self._news:
            if text != self._last:
                self._version, self._last = self._version + 1, text
                self._state = {**state, 'version': self._version}
                self._news.notify_all()

    def _found(self) -> list[Entry]:
        """Return this robot's machines by the last answers; those with a record come first."""
        records = machines.recorded(self.store, self._name)
        ids = {(record.name, record.machine_id) for record in records.values()}
        if ids != self._known:
            self._known, self._asked = ids, -1e9
        entries = []
        for entry in machines.combined(records, self._answers):
            record = records.get(entry.name)
            # A machine that the provider did not know yet has to be asked for again.
            if entry.machine is None and (entry.name, entry.machine_id) not in self._answered:
                entry = dataclasses.replace(entry, asked=False)
            # A record without an id may be that of a machine that the provider knows already.
            if entry.own and (entry.record or record is None or record.machine_id):
                entries.append(entry)
        return sorted(entries, key=lambda entry: entry.record is None)

    def _key(self, entry: Entry) -> str:
        """
        Return the key of a machine for as long as it is shown: its name.

        If several machines have one name (in several regions), later keys also contain the id.
        """
        first = self._shown.get(entry.name)
        for key, shown in self._shown.items():
            if shown.entry.name == entry.name and not shown.ended and shown.is_of(entry):
                return key
        if first is None or first.ended:
            return entry.name
        return f'{entry.name} {entry.machine_id}'

    def _look_at_launches(self, now: float) -> None:
        folder = self.store.root / 'launches'
        folders = {path.name: path for path in folder.iterdir()} if folder.is_dir() else {}
        for name, path in folders.items():
            launch = self._launches.setdefault(name, ShownLaunch())
            launch.pid, alive = launch_process(path)
            launch.alive = alive or not launch.pid  # without a file it has just started
            launch.read(path)
        for name, launch in list(self._launches.items()):
            if name not in folders:
                if launch.file is not None:
                    launch.read(folder / name)
                    launch.close()
                launch.alive = False
                launch.ended = launch.ended or now
                if now - launch.ended > KEPT:
                    del self._launches[name]

    def _update(self, shown: Shown, now: float, *, is_present: bool) -> None:
        record = shown.entry.record
        if is_present and record is not None and record.launch:
            shown.launch = record.launch
        launch = self._launches.get(shown.launch)
        if launch is not None:
            shown.steps = tuple(step for step in launch.contents.steps
                                if step.machine == shown.entry.name)
            shown.clock = launch.contents.clocks.get(shown.entry.name)
        folder = self.store.root / 'launches' / shown.launch
        shown.unread.clear()
        for name, each in self._tables.items():
            rows = shown.figures.pop(name, None)
            try:
                rows = each.figures(folder, shown.entry.name)
            except Exception as error:  # noqa: BLE001 - a feature's defect must not end the view
                shown.unread[name] = plugin_system.cause(error)
            if rows is not None:
                shown.figures[name] = rows
        if not is_present:
            shown.ended = shown.ended or now
        if not (self.watched and is_present and record is not None and record.launch_alive):
            if shown.follower is not None:
                shown.follower.stop()
                shown.follower = None
        elif shown.follower is not None:
            shown.follower.know(shown.entry)
        elif record.agent and (
                not (launch and launch.contents.steps) or phase(shown.steps) == 'running'):
            shown.follower = Follower(shown.entry, self._wake.set)

    # -- as JSON --------------------------------------------------------------------------------

    def _make(self) -> dict[str, Any]:
        return {
            'robot': robot_name(),
            'warnings': list(self._warnings),
            'launches': [
                {'id': name, 'pid': launch.pid, 'alive': launch.alive and not launch.ended,
                 'steps': [as_json(step) for step in launch.contents.steps if not step.machine]}
                for name, launch in sorted(
                    self._launches.items(), key=lambda item: item[1].ended or 1e12)],
            'machines': [machine_json(key, shown) for key, shown in sorted(self._shown.items())],
        }
