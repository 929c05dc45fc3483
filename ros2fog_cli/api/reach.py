# SPDX-License-Identifier: Apache-2.0
"""Reaching a machine by its name: its shell, its agent, its VPN."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import os
import re
import socket
import sys
import threading
import time
from typing import Any, Optional

from fogros2 import journal, plugin_system, process
from fogros2 import shell as shells
from fogros2.agent_client import AgentClient
from fogros2.clock import ClockOffset
from fogros2.errors import AgentError, ConnectError, DdsError, FogError, MachineNotFound
from fogros2.model import Command, Endpoint
from fogros2.shell import Shell
from fogros2.store import Record, Store
from fogros2.vpn import Vpn
from ros2fog_cli.api import machines
from ros2fog_cli.api.machines import Entry


def find(
    name: str, warn: Callable[[str], None], *, regions: Optional[list[str]] = None,
) -> Entry:
    """
    Return the machine of that name; asks one provider where this robot knows which.

    :raises ConfigurationError: there is none, or several.
    """
    folder = Store().machine(name)
    if folder.exists() and not regions:
        try:
            record = folder.load()
            machine = None
            if record.machine_id is not None:
                machine = machines.load(record.provider).describe(record.machine_id)
            return Entry(name, record.provider, machine, record)
        except FogError as error:
            warn(f'{name}: {error}')
    return machines.one(machines.survey(warn, name=name, regions=regions), name)


def endpoint(entry: Entry, user: Optional[str] = None) -> Endpoint:
    """
    Return where the machine's shell is, with this robot's key if it has one.

    :raises ConnectError: it has none, as it doesn't run.
    """
    found = entry.machine.shell if entry.machine is not None else None
    if entry.record is not None and entry.record.shell is not None:
        known = entry.record.shell
        # the provider knows where it is now, the record which key it takes
        found = dataclasses.replace(
            found, key_file=known.key_file, user=known.user,
            host_key=known.host_key or found.host_key) if found is not None else known
    if found is None:
        raise ConnectError(f"the machine '{entry.name}' can't be reached: {entry.state}")
    return dataclasses.replace(found, user=user) if user else found


@contextlib.contextmanager
def session(
    entry: Entry, user: Optional[str] = None, timeout: float = 15.0,
) -> Iterator[Shell]:
    """
    Yield the machine's shell, which connects when first used; closed after the block.

    Behind a firewall that the launch has closed, it goes through the VPN while the robot has one
    to it; else this robot is let in for as long as the block takes. Another robot's machine isn't
    opened: that would lock its own robot out, which may be on its way in.

    :raises FogError: it can't be reached.
    """
    to = endpoint(entry, user)
    with contextlib.ExitStack() as undo:
        if firewalled(entry):
            inside = through_vpn(entry, to)
            if inside is not None:
                to = inside
            elif entry.own:
                _open(entry, to.port, undo)
        found = shells.connect(to, name=entry.name, timeout=timeout)
        undo.callback(found.close)
        yield found


def firewalled(entry: Entry) -> bool:
    """Return whether the machine's provider decides who reaches it."""
    return entry.machine is not None and machines.load(entry.provider).firewall


def through_vpn(
    entry: Entry, to: Endpoint, patience: float = 1.5,
) -> Optional[Endpoint]:
    """Return an endpoint within the VPN, None where nothing answers there in time (s)."""
    record = entry.record
    if record is None or record.vpn is None or not record.launch_alive:
        return None
    try:
        socket.create_connection((record.vpn.address, to.port), timeout=patience).close()
    except OSError:
        return None
    return dataclasses.replace(to, host=record.vpn.address)


def _open(entry: Entry, port: int, undo: contextlib.ExitStack) -> None:
    """Let this robot in until ``undo`` runs; under a launch, until that closes it again."""
    assert entry.machine is not None
    provider, machine_id = machines.load(entry.provider), entry.machine.id
    provider.allow(machine_id, port, [provider.robot_address()])

    def close() -> None:
        # a launch may have begun meanwhile, and be on its way in
        record = entry.record
        if record is not None:
            with contextlib.suppress(FogError):
                record = Store().machine(entry.name).load()
        if record is None or not record.launch_alive:
            try:
                provider.allow(machine_id, port, [])
            except MachineNotFound:
                pass  # gone, and its firewall with it
            except FogError as error:
                print(f'{entry.name}: its TCP port {port} is still open to this computer, as '
                      f'closing it failed: {error}', file=sys.stderr)

    undo.callback(close)


def let_go(entry: Entry) -> bool:
    """
    Return whether a machine is kept for a launch to come, and has no agent until then.

    Where the agent comes with a launch (a pod), it leaves with it.
    """
    return entry.record is not None and not entry.record.launch \
        and not machines.load(entry.provider).agent_directory


def agent(entry: Entry, to: Shell) -> AgentClient:
    """
    Return a connection to the machine's agent.

    :raises AgentError: this robot doesn't know where it is, or there is none.
    """
    record = entry.record
    if let_go(entry):
        raise AgentError(f"nothing of a launch runs on '{entry.name}': it is kept for the next "
                         'one, and the agent of the last one has left with its log')
    if record is None or not record.agent or not record.agent_program:
        raise AgentError(f"this robot knows of no agent on '{entry.name}'",
                         'only the robot that launched it does')
    return AgentClient(to, record.agent, agent_path=record.agent_program, python=record.python)


@dataclasses.dataclass(frozen=True)
class Link:
    """
    The VPN to a machine, seen from the robot.

    :param handshake_age: seconds since the last handshake, None before the first.
    :param received: bytes from the machine, ``sent`` bytes to it.
    :param latency: median round trip of a ping in milliseconds, None where none came back.
    """

    address: str
    interface: str
    handshake_age: Optional[float] = None
    received: float = 0.0
    sent: float = 0.0
    latency: Optional[float] = None


def link(record: Record, *, pings: int = 5) -> Optional[Link]:
    """
    Return how the VPN to a machine does, None while the robot has none to it.

    :param pings: how many the round trip is measured by, a fifth of a second each.
    :raises FogError: the interface can't be asked.
    """
    if record.vpn is None or record.robot_vpn is None:
        return None
    vpn: Vpn = plugin_system.load('fogros2.vpn', record.spec.vpn)()
    asked = process.run(vpn.status(record.robot_vpn), timeout=10.0)
    peer = vpn.parse_status(asked.stdout).get(record.public_key, {})
    handshake = peer.get('handshake', 0.0)
    return Link(
        record.vpn.address, record.robot_vpn.name,
        time.time() - handshake if handshake else None,
        peer.get('received', 0.0), peer.get('sent', 0.0), ping(record.vpn.address, pings))


def ping(address: str, count: int = 5) -> Optional[float]:
    """Return the median round trip in milliseconds, None where nothing comes back."""
    try:
        result = process.run(
            Command(('ping', '-n', '-c', str(count), '-i', '0.2', '-W', '1', address)),
            timeout=count + 5.0, check=False)
    except FogError:
        return None
    times = sorted(float(t) for t in re.findall(r'time=([0-9.]+) ms', result.stdout))
    return times[len(times) // 2] if times else None


def clock(record: Record, store: Store) -> Optional[ClockOffset]:
    """Return the offset that the launch measured last, None without a launch or measurement."""
    if not record.launch or not record.launch_alive:
        return None
    return journal.read_clocks(store.root / 'launches' / record.launch).get(record.name)


def follow(
    client: AgentClient, show: Callable[[dict[str, Any]], None], *, forever: bool,
) -> bool:
    """
    Hand the agent's events to ``show`` from the first on, until the last or for ever.

    Returns False if the agent vanished meanwhile; a Ctrl-C is the way out of for ever.

    :raises BrokenPipeError: nobody reads what is shown any more.
    """
    last = int(client.request('status')['next']) - 1
    over, absent, unheard = threading.Event(), threading.Event(), threading.Event()

    def take(event: dict[str, Any]) -> None:
        if event.get('event') == 'connection':
            if event.get('state') == 'absent':
                absent.set()
                over.set()
            return
        try:
            show(event)
        except BrokenPipeError:
            unheard.set()  # as behind `| head`
            over.set()
        if not forever and int(event.get('seq', 0)) >= last:
            over.set()

    if last < 1 and not forever:
        return True
    client.subscribe(take, since=1)
    while not over.wait(0.5 if forever else 30.0):
        if not forever:
            return False
    if unheard.is_set():
        raise BrokenPipeError
    return not absent.is_set()


def hush() -> None:
    """Let what is still to be printed go nowhere: the interpreter's end would complain again."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for target in (1, 2):
        os.dup2(nowhere, target)
    os.close(nowhere)


def robot_environment(record: Record, store: Store) -> Optional[dict[str, str]]:
    """
    Return the variables with which another terminal's nodes join a launch, None if it is over.

    :raises FogError: the user's RMW_IMPLEMENTATION is one that can't join.
    """
    chosen = store.root / 'launches' / record.launch / 'rmw'
    if not record.launch or not record.launch_alive or not chosen.exists():
        return None
    rmw = chosen.read_text()
    own = os.environ.get('RMW_IMPLEMENTATION') or rmw
    if own != rmw:
        raise DdsError(f'the launch has RMW_IMPLEMENTATION={rmw}, this terminal {own}',
                       'unset RMW_IMPLEMENTATION here')
    vendor = plugin_system.load('fogros2.dds', rmw)()
    path = chosen.with_name(vendor.file_name)
    return {**vendor.environment(str(path), os.environ),
            'ROS_DOMAIN_ID': chosen.with_name('domain').read_text()}
