# SPDX-License-Identifier: Apache-2.0
"""Delete machines, and clean up what dead launches left on this robot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed, ThreadPoolExecutor
import contextlib
import dataclasses
import functools
from pathlib import Path
import re
import time
from typing import Optional

from fogros2.agent_client import AgentClient
from fogros2.deploy import undo
from fogros2.deploy.robot import clear
from fogros2.errors import (
    AgentError,
    ConfigurationError,
    DeadlineExceeded,
    FogError,
    MachineNotFound,
    NameTaken,
    ProviderError,
    ShellError,
    StoreError,
)
from fogros2.model import Command, Machine, MachineState
from fogros2.provider import Provider
from fogros2.report import Reporter, step
from fogros2.shell import Shell
from fogros2.store import is_another_robot, launch_process, Record, Store
from fogros2.vpn import owner
from fogros2.waiting import Timeouts
from ros2fog_cli.api import machines, reach
from ros2fog_cli.api.machines import Entry

#: Seconds after the end of its lifetime in which a machine may still be deleting itself.
GRACE = 60.0
#: Age in seconds after which gc deletes a launch's folder that has no process file.
FOLDER_AGE = 86400.0


def check_free(entry: Entry, *, force: bool) -> None:
    """
    Refuse to delete a machine that a running launch uses, or may use on another computer.

    :raises NameTaken: the launch is alive, or the record is in a state folder that was copied from
        another computer; and ``force`` is False.
    """
    record = entry.record
    if record is None or force:
        return
    if record.launch_alive:
        raise NameTaken(f"the launch with process {record.pid} has the machine '{entry.name}'",
                        'end that launch, or delete with --force')
    if entry.machine is not None and is_another_robot(record.robot):
        raise NameTaken(
            f"the machine '{entry.name}' belongs to the robot {record.robot}: the state folder is "
            'a copy, or this computer has another network card',
            'delete it there, or with --force')


def delete(entry: Entry, store: Store, report: Reporter, *, force: bool = False) -> None:
    """
    Delete a machine, then the resources that this robot keeps for it; idempotent.

    :param force: also delete a machine that a running launch uses, and forget a machine that
        cannot be reached.
    :raises FogError: the machine or one of its resources still exists, or a launch has got the
        machine or its name since ``entry`` was found.
    """
    check_free(entry, force=force)
    with contextlib.nullcontext() if entry.record is None or force \
            else store.lock(entry.name):
        if not force:
            record = _current(entry.name, entry.record, entry.machine, store)
            entry = dataclasses.replace(entry, record=record or entry.record)
        if not entry.asked and not force:
            raise ConfigurationError(
                f"the provider '{entry.provider}' of '{entry.name}' can't be asked",
                '--force forgets the machine here; it may go on by itself')
        if entry.machine is not None:
            if entry.record is not None and not entry.machine.owned:
                _leave(entry, entry.record, entry.machine, force=force)
            _destroy(entry.machine)
        record = entry.record
        if record is None:
            return
        if record.damage:
            if entry.machine is None and not force:
                raise StoreError(
                    f"the record of '{record.name}' can't be read, and no provider knows it",
                    'the version that wrote the record reads it; --force forgets the machine, and '
                    'leaves what is on an SSH host')
            store.delete(record.name)
            return
        # The machine deleted itself, or was never created; its resources may still exist.
        if entry.machine is None and entry.asked and not undo.end_machine(
                machines.load(record.provider), record):
            store.set_aside(record)
        if force and record.launch_alive:
            # The launch will notice that the machine is gone, and will clean up itself.
            return
        if record.launch:
            with step(report, record.name, 'VPN interface'):
                clear(store.root / 'launches' / record.launch)
        store.delete(record.name)


def _current(
    name: str, record: Optional[Record], machine: Optional[Machine], store: Store,
) -> Optional[Record]:
    """
    Return this robot's record of a machine as it is now, None if there is none any more.

    :param record: as it was found with ``machine``.
    :raises NameTaken: another launch has written the record meanwhile.
    """
    records = machines.recorded(store, name)
    current = records.get(name)
    if record is None and machine is not None:
        current = machines.record_of(machine, records)
    if current is not None and (record is None or any(
            getattr(current, each) != getattr(record, each)
            for each in ('token', 'machine_id', 'last'))):
        raise NameTaken(f"'{name}' has changed meanwhile", 'try again')
    return current


def delete_all(
    entries: Sequence[Entry], store: Store, report: Reporter, *, force: bool,
) -> Iterator[tuple[Entry, Optional[FogError]]]:
    """Delete machines in parallel; yield each one when it is done, with its error or None."""
    with ThreadPoolExecutor(min(16, max(1, len(entries))), 'fog-delete') as pool:
        doing = {pool.submit(delete, entry, store, report, force=force): entry
                 for entry in entries}
        for done in as_completed(doing):
            error = done.exception()
            if error is not None and not isinstance(error, FogError):
                raise error
            yield doing[done], error


def _destroy(machine: Machine) -> None:
    """
    Delete a machine, and check that it is gone.

    :raises ProviderError: the machine still exists.
    """
    provider = machines.load(machine.provider)
    provider.destroy(machine.id)
    if not machine.owned:
        return
    try:
        state = provider.describe(machine.id).state
    except MachineNotFound:
        return
    if state is not MachineState.DELETED:
        raise ProviderError(f"'{machine.name}' ({machine.id}) is still there: {state}",
                            f'ros2 fog delete {machine.name} tries again')


@contextlib.contextmanager
def _agent(record: Record, shell: Shell) -> Iterator[Optional[AgentClient]]:
    """Yield a client of the agent that a record names, None if the agent has ended."""
    if not record.agent or not record.agent_program or shell.run(
            # An agent that ended deleted its program; a request would wait for seconds.
            Command(('test', '-e', record.agent_program), what='look for the agent'),
            timeout=Timeouts().command, check=False).returncode != 0:
        yield None
        return
    client = AgentClient(shell, record.agent, agent_path=record.agent_program)
    try:
        yield client
    finally:
        client.close()


class _Left(undo.Site):
    """
    What a launch that died has left on a machine, which is let go for good.

    :param shell: to the machine; None where only its provider is needed.
    """

    def __init__(self, record: Record, machine: Machine, shell: Optional[Shell] = None) -> None:
        self.record = dataclasses.replace(
            record, spec=dataclasses.replace(record.spec, on_exit='delete'))
        self.machine = machine
        self._shell = shell

    @property
    def provider(self) -> Provider:
        return machines.load(self.record.provider)

    def clean_up(self, commands: Iterable[Command]) -> str:
        assert self._shell is not None
        output = ''
        for command in commands:
            output = self._shell.run(command, timeout=Timeouts().command).stdout
        return output

    def release(self) -> None:
        assert self._shell is not None
        with _agent(self.record, self._shell) as client, contextlib.suppress(AgentError):
            if client is not None:  # else it has ended by itself
                client.request('release', on_exit='delete', exit=True, timeout=30.0)


def _leave(entry: Entry, record: Record, machine: Machine, *, force: bool) -> None:
    """Undo what a launch has made on a computer that FogROS2 does not own."""
    if record.endpoint is None and not record.made:
        return
    account = machines.load(record.provider).capabilities.account
    try:
        with reach.session(entry, timeout=10.0) as shell:
            with _agent(record, shell) as client, contextlib.suppress(AgentError):
                if client is not None:
                    launch = client.status()['launch']
                    if launch not in ('', record.launch, record.last):
                        return  # our agent is gone, and another robot uses the computer now
            undo.unmake_all(_Left(record, machine, shell), record.made)
    except FogError as error:
        # another robot may have taken the account away
        taken = account and isinstance(error, (ShellError, DeadlineExceeded))
        if not force and not taken:
            raise


@dataclasses.dataclass(frozen=True)
class Due:
    """
    Something that gc should clear.

    :param what: kind of thing; ``name`` is its name, and ``reason`` says why it is due.
    :param end: function that clears it; raises FogError if that fails.
    :param error: why it cannot be cleared; ``end`` then does nothing.
    """

    what: str
    name: str
    reason: str
    end: Callable[[], None] = lambda: None
    error: str = ''


def due(
    entries: Iterable[Entry], store: Store, keep_stopped: float, report: Reporter,
) -> Iterator[list[Due]]:
    """
    Yield what gc should clear: machines, requests, and what dead launches left on this robot.

    The things in a list can be cleared at the same time, before the next list.
    """
    now = time.time()
    yield list(_due_machines(entries, store, keep_stopped, report, now))
    yield [Due('machine', record.name, 'its provider had not answered the request for it',
               functools.partial(end_request, record, age, store))
           for record, age in store.requests()]
    folders = leftovers(store, now)
    launches = {record.launch for record in store.machines()}
    folders += [store.root / 'launches' / launch for launch in owner.abandoned()
                if launch not in launches and store.root / 'launches' / launch not in folders]
    yield [Due('leftovers of launch', folder.name, 'the launch is gone',
               functools.partial(clear, folder)) for folder in folders]


def _due_machines(
    entries: Iterable[Entry], store: Store, keep_stopped: float, report: Reporter, now: float,
) -> Iterator[Due]:
    for entry in entries:
        record = entry.record
        dead = record is not None and record.launch and not record.launch_alive
        reason = why_end(entry, now, keep_stopped,
                         stopped_at(entry.machine, entry.record, store))
        if dead and not entry.asked:
            yield Due('machine', entry.name, 'its launch is gone',
                      error=f"the provider '{entry.provider}' can't be asked")
        elif reason:
            yield Due('leftovers of' if entry.gone else 'machine', entry.name, reason,
                      functools.partial(delete, entry, store, report))
        elif record is not None and not record.damage and not record.launch_alive:
            # the record of a copied state folder lists ports of another computer's launch
            machine = entry.machine if entry.own else None
            if dead:
                reason = 'its launch is gone'
            elif machine is not None and any(made.kind in undo.PORTS for made in record.made):
                reason = 'its launch could not close a port'
            else:
                continue
            yield Due('leftovers of', entry.name, reason,
                      functools.partial(let_go, record, machine, store))


def end_request(record: Record, age: float, store: Store) -> None:
    """
    Delete the machine of a request that got no answer; forget the request.

    :raises FogError: the machine may still appear, or the provider does not answer.
    """
    # the launch may have requested the machine again; without an id, it could be either one
    again = [each.machine_id for each in store.machines()
             if (each.name, each.last) == (record.name, record.last)
             and each.token != record.token]
    if None in again or not undo.end_machine(
            machines.load(record.provider), record, age, keep=again):
        raise undo.late(record)
    store.answered(record)


def awaited(store: Store, name: str) -> list[str]:
    """Return warnings of the machines with a name that may still appear."""
    return [str(undo.late(record)) for record, _ in store.requests() if record.name == name]


def why_end(
    entry: Entry, now: float, keep_stopped: float, stopped_at: Optional[float] = None,
) -> str:
    """
    Return why gc should delete a machine, '' if gc should keep it.

    :param keep_stopped: seconds for which gc keeps a stopped machine.
    :param stopped_at: when the machine was stopped, in seconds since the epoch; None: unknown.
    """
    record = entry.record
    if record is not None and (record.launch_alive or record.damage and entry.machine is None):
        return ''
    if not entry.asked or not entry.own:
        return ''
    if entry.gone:
        return 'gone at its provider' if entry.machine_id else 'its launch is gone'
    assert entry.machine is not None
    if record is not None and record.launch and (
            record.spec.on_exit == 'delete' or record.machine_id is None):
        # also if it was made and not started yet; without an id, no launch can keep it
        return 'its launch is gone'
    if entry.machine.state is MachineState.STOPPED:
        if not entry.machine.owned:
            return ''  # a computer of the user that does not answer, perhaps for weeks
        since = stopped_at if stopped_at is not None else entry.created
        if since is not None and now - since > keep_stopped:
            return f'stopped for more than {keep_stopped / 86400:g} days'
        return ''
    if entry.expires is not None and now > entry.expires + GRACE:
        return 'past its lifetime'
    return ''


def stopped_at(
    machine: Optional[Machine], record: Optional[Record], store: Store,
) -> Optional[float]:
    """Return when a machine was stopped: from the provider, else when its record was written."""
    if machine is not None and machine.stopped is not None:
        return machine.stopped
    if record is None:
        return None
    try:
        written = (store.machine(record.name) / 'record.json').stat().st_mtime
        return max(written, record.earliest)
    except OSError:
        return None


def tidy(warn: machines.Warn, *, regions: Optional[Sequence[str]] = None) -> list[str]:
    """
    Let all providers delete the leftovers of machines that deleted themselves.

    Return a line of text for each deleted resource; warn about a provider that does not answer.
    """
    return machines.gather(warn, regions, lambda name: machines.load(name, regions).tidy())


def let_go(record: Record, machine: Optional[Machine], store: Store) -> None:
    """
    Clean up after a dead launch whose machine is kept; the machine stays.

    :param machine: as the provider reports it; None if its ports are not this robot's to close.
    :raises FogError: a resource could not be cleaned up.
    """
    with store.lock(record.name):
        current = _current(record.name, record, machine, store)
        if current is None:
            return  # somebody has deleted it
        if current.launch:
            clear(store.root / 'launches' / current.launch)
        record = store.save(dataclasses.replace(
            current, launch='', pid=0, pid_start=0, robot_vpn=None))
        if machine is not None:
            store.save(dataclasses.replace(
                record, notes={}, made=undo.close_ports(_Left(record, machine))))


def leftovers(store: Store, now: Optional[float] = None) -> list[Path]:
    """Return the folders of dead launches that no machine's record names."""
    now = time.time() if now is None else now
    named = {record.launch for record in store.machines() if record.launch}
    folder = store.root / 'launches'
    return [path for path in (sorted(folder.iterdir()) if folder.is_dir() else [])
            if path.name not in named and re.fullmatch('[0-9a-f]{6}', path.name)
            and _dead(path, now)]


def _dead(folder: Path, now: float) -> bool:
    """Return whether a folder belongs to a dead launch: no process, or an old folder."""
    pid, alive = launch_process(folder)
    if pid:
        return not alive
    runs = owner.alive(f'fog{folder.name}')
    try:
        return not runs if runs is not None else now - folder.stat().st_mtime > FOLDER_AGE
    except OSError:
        return False
