# SPDX-License-Identifier: Apache-2.0
"""Reach a machine by its name: its shell, its agent and its VPN."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import fcntl
import math
import os
from pathlib import Path
import re
import socket
import sys
import threading
import time
from typing import cast, Optional

from fogros2 import journal, plugin_system, process
from fogros2 import shell as shells
from fogros2.agent_client import AgentClient
from fogros2.clock import ClockOffset
from fogros2.errors import AgentError, ConnectError, DdsError, FogError, MachineNotFound
from fogros2.events import Event
from fogros2.model import Command, Endpoint, MachineState, VpnInterface
from fogros2.provider import TAG_ON_EXIT
from fogros2.shell import Shell
from fogros2.store import Record, Store
from fogros2.vpn import Vpn
from ros2fog_cli.api import machines
from ros2fog_cli.api.machines import Entry

#: Seconds without an event after which a log that is not followed counts as cut off, and between
#: two looks at the time.
SILENCE, LOOK = 30.0, 0.5


def find(
    name: str, warn: Callable[[str], None], *, regions: Optional[list[str]] = None,
) -> Entry:
    """
    Return the machine of that name; ask only its provider if this robot has a record.

    :raises ConfigurationError: no machine, or several machines have that name.
    """
    store = Store()
    if store.exists(name) and not regions:
        try:
            record = store.load(name)
            machine = None
            if record.machine_id is not None:
                machine = machines.load(record.provider).describe(record.machine_id)
            return Entry(name, record.provider, machine, record)
        except FogError as error:
            warn(f'{name}: {error}')
    return machines.one(machines.survey(warn, name=name, regions=regions), name)


def endpoint(entry: Entry, user: Optional[str] = None) -> Endpoint:
    """
    Return the endpoint of the machine's shell, with this robot's key if there is one.

    :raises ConnectError: the machine has no shell, because it does not run.
    """
    result = entry.machine.endpoint if entry.machine is not None else None
    if entry.record is not None and entry.record.endpoint is not None:
        stored = entry.record.endpoint
        # The provider knows the current address, the record knows the key.
        result = dataclasses.replace(
            result, key_file=stored.key_file, user=stored.user,
            host_key=stored.host_key or result.host_key) if result is not None else stored
    stopped = entry.machine is not None and entry.machine.state is MachineState.STOPPED
    if result is None or stopped:
        raise ConnectError(f"the machine '{entry.name}' can't be reached: {entry.state}",
                           '' if not stopped else 'a launch that names it starts it again'
                           if entry.known.owned else 'is it on?')
    return dataclasses.replace(result, user=user) if user else result


@contextlib.contextmanager
def session(
    entry: Entry, user: Optional[str] = None, timeout: float = 15.0, *, opens: bool = True,
) -> Iterator[Shell]:
    """
    Yield the machine's shell, which connects at the first use, and close it after the block.

    If the provider has a firewall, connect through the VPN while the robot has one to the machine.
    Otherwise open the firewall for this robot until the block ends. Never open the firewall of
    another robot's machine: that would lock out its own robot.

    :param opens: False: never open the firewall.
    :raises FogError: the machine cannot be reached.
    """
    to = endpoint(entry, user)
    with contextlib.ExitStack() as undo:
        if machines.load(entry.provider).capabilities.firewall:
            inside = through_vpn(entry, to)
            if inside is not None:
                to = inside
            elif not opens:
                raise ConnectError(f"'{entry.name}' can't be reached through the VPN")
            elif entry.own and entry.machine is not None:
                _open(entry, to.port, undo)
        shell = shells.connect(to, name=entry.name, timeout=timeout)
        undo.callback(shell.close)
        yield shell


def through_vpn(entry: Entry, to: Endpoint) -> Optional[Endpoint]:
    """Return an endpoint in the VPN, None if it does not answer at once."""
    record = entry.record
    if record is None or record.vpn is None or not record.launch_alive:
        return None
    try:
        socket.create_connection((record.vpn.address, to.port), timeout=1.5).close()
    except OSError:
        return None
    return dataclasses.replace(to, host=record.vpn.address)


def _open(entry: Entry, port: int, undo: contextlib.ExitStack) -> None:
    """
    Open a TCP port to this robot until ``undo`` runs or a launch closes the port.

    Of several programs on this computer, the last one closes the port.
    """
    assert entry.machine is not None
    provider, machine_id = machines.load(entry.provider), entry.machine.id
    address, users = provider.robot_address(), -1
    if entry.record is not None:
        users = os.open(Store().machine(entry.record.name), os.O_RDONLY)
        undo.callback(os.close, users)
        fcntl.flock(users, fcntl.LOCK_SH)

    def close() -> None:
        try:
            if users >= 0:
                fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return
        # A launch may have started meanwhile, and may be connecting through this port.
        record = entry.record
        if record is not None:
            with contextlib.suppress(FogError):
                record = Store().load(entry.name)
        if record is None and entry.known.tags.get(TAG_ON_EXIT) == 'keep':
            # without a record, the networks of its fleet, if it has one, are unknown
            print(f'{entry.name}: its TCP port {port} stays open to this computer, which has no '
                  'record of the machine', file=sys.stderr)
        elif record is None or not record.launch_alive:
            try:
                provider.allow(
                    machine_id, port, provider.ssh_networks(record.spec) if record else ())
            except MachineNotFound:
                pass  # the machine is gone, with its firewall
            except FogError as error:
                print(f'{entry.name}: its TCP port {port} may still be open to this computer, as '
                      f'closing it failed: {error}', file=sys.stderr)

    undo.callback(close)
    provider.allow(machine_id, port, [address])


def let_go(entry: Entry) -> bool:
    """
    Return whether a machine is kept for a later launch and has no agent until then.

    An agent that comes with the launch (as in a pod) ends with it.
    """
    return entry.record is not None and not entry.record.launch \
        and not machines.load(entry.provider).capabilities.agent_directory


def agent(entry: Entry, to: Shell) -> AgentClient:
    """
    Return a client of the machine's agent.

    :raises AgentError: the machine has no agent, or this robot does not know its location.
    """
    record = entry.record
    if let_go(entry):
        raise AgentError(f"no launch runs on '{entry.name}': the machine is kept for the next "
                         'launch, and the agent of the last one has ended with its log')
    if record is None or not record.agent or not record.agent_program:
        raise AgentError(f"this robot has no record of an agent on '{entry.name}'",
                         'only the robot that launched the machine has one')
    return AgentClient(to, record.agent, agent_path=record.agent_program)


@dataclasses.dataclass(frozen=True)
class Link:
    """
    The VPN link to a machine, seen from the robot.

    :param handshake_age: seconds since the last handshake, None before the first one.
    :param received: bytes received from the machine; ``sent`` bytes were sent to it.
    :param latency: median round trip of a ping in milliseconds, None if no ping was answered.
    :param carried: what carries its packets in place of UDP, '' for nothing.
    """

    address: str
    interface: str
    handshake_age: Optional[float] = None
    received: float = 0.0
    sent: float = 0.0
    latency: Optional[float] = None
    carried: str = ''


def link(record: Record, *, pings: int = 5) -> Optional[Link]:
    """
    Measure the VPN link to a machine; return None if the robot has no VPN to it.

    :param pings: number of pings for the round trip, one every 0.2 s.
    :raises FogError: the status of the interface cannot be read.
    """
    if record.vpn is None or record.robot_vpn is None:
        return None
    return dataclasses.replace(
        measure(record.vpn.address, record.robot_vpn, record.public_key, pings),
        carried=record.carried)


def measure(address: str, interface: VpnInterface, key: str, pings: int = 5) -> Link:
    """
    Measure the link from an interface of this computer to a machine.

    :param key: the machine's public key.
    :raises FogError: the status of the interface cannot be read.
    """
    vpn: Vpn = plugin_system.load('fogros2.vpn', 'wireguard')()
    status = process.run(vpn.status(interface), timeout=10.0)
    peer = vpn.parse_status(status.stdout).get(key, {})
    handshake = peer.get('handshake', 0.0)
    return Link(address, interface.name, time.time() - handshake if handshake else None,
                peer.get('received', 0.0), peer.get('sent', 0.0), ping(address, pings))


def ping(address: str, count: int = 5) -> Optional[float]:
    """Return the median round trip of pings in milliseconds, None if no ping was answered."""
    try:
        result = process.run(
            Command(('ping', '-n', '-c', str(count), '-i', '0.2', '-W', '1', address),
                    environment={'LC_ALL': 'C'}),
            timeout=count + 5.0, check=False)
    except FogError:
        return None
    times = sorted(float(t) for t in re.findall(r'time=([0-9.]+) ms', result.stdout))
    return times[len(times) // 2] if times else None


def clock(record: Record, store: Store) -> Optional[ClockOffset]:
    """Return the clock offset that the launch measured last, None if there is none."""
    if not record.launch or not record.launch_alive:
        return None
    return journal.read(store.root / 'launches' / record.launch).clocks.get(record.name)


def follow(
    client: AgentClient, show: Callable[[Event], None], *, forever: bool,
) -> bool:
    """
    Pass the agent's events to ``show``, from the first one to the last, or until Ctrl-C.

    Return False if the agent disappeared, or sent no event for ``SILENCE`` s, without ``forever``.

    :param forever: also pass future events.
    :raises BrokenPipeError: the reader of the output is gone.
    """
    last = client.status()['next'] - 1
    over, absent, unheard = threading.Event(), threading.Event(), threading.Event()
    heard = time.monotonic()

    def take(event: Event) -> None:
        nonlocal heard
        if event['event'] == 'connection':
            if event['state'] == 'absent':
                absent.set()
                over.set()
            return
        heard = math.inf  # an output that blocks, such as of `less`, is no silence
        try:
            show(event)
        except BrokenPipeError:
            unheard.set()  # as with `| head`
            over.set()
        heard = time.monotonic()
        if not forever and cast(int, event.get('seq', 0)) >= last:
            over.set()

    if last < 1 and not forever:
        return True
    client.subscribe(take, since=1)
    while not over.wait(LOOK):
        if not forever and time.monotonic() - heard > SILENCE:
            return False
    if unheard.is_set():
        raise BrokenPipeError
    return not absent.is_set()


def robot_environment(record: Record, store: Store) -> Optional[dict[str, str]]:
    """
    Return the variables to join a launch from another terminal, None if the launch is over.

    :raises FogError: the user's RMW_IMPLEMENTATION differs from the launch's.
    """
    folder = store.root / 'launches' / record.launch
    if not record.launch or not record.launch_alive or not (folder / 'rmw').exists():
        return None
    return variables_of(folder)


def variables_of(folder: Path) -> dict[str, str]:
    """
    Return the variables of a launch's folder, by which nodes of this computer join it.

    :raises FogError: the user's RMW_IMPLEMENTATION differs from the launch's, or another variable
        keeps nodes from machines.
    """
    rmw = (folder / 'rmw').read_text()
    own = os.environ.get('RMW_IMPLEMENTATION') or rmw
    if own != rmw:
        raise DdsError(f'the launch has RMW_IMPLEMENTATION={rmw}, this terminal {own}',
                       'unset RMW_IMPLEMENTATION here')
    vendor = plugin_system.load('fogros2.dds', rmw)()
    variables = vendor.environment(str(folder / vendor.file_name), os.environ)
    # only for its checks of what the launch's variables do not replace
    vendor.robot_interfaces('', None, {
        name: value for name, value in os.environ.items() if name not in variables})
    return {**variables, 'ROS_DOMAIN_ID': (folder / 'domain').read_text()}
