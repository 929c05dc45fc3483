# SPDX-License-Identifier: Apache-2.0
"""
Send packets of a stranger to the ports that a launch opened, and count the replies.

The stranger who attacks the machine has the robot's own address, as one behind the same NAT: the
provider's firewall admits him, and where there is one it is opened for all UDP. For a pod he is
on its node. The stranger who attacks the robot is a computer in its network. Addresses are IPv4.
Ports are those of sockets on other addresses than the loopback's and the VPN's, and closed ones.
"""

from __future__ import annotations

import base64
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
import contextlib
import dataclasses
import hashlib
import ipaddress
import itertools
import json
import os
from pathlib import Path
import random
import secrets
import selectors
import socket
import subprocess
import threading
import time
from typing import Any

from figures.places import Boxed, computer, Container, Host, Place, Pod
from figures.robots import DOMAIN, Robot, robot, UP
from figures.secrets_scan import agent_of
from fogros2.agent.protocol import BEAT, sign
from fogros2.plan import HEARTBEAT_PORT
from fogros2.vpn.addresses import dds_ports
from fogros2.waiting import wait_until
from rigs import rtps
from rigs.computers.netns import answers, made_in
from rigs.launched import Launched, ros2
from rigs.traces import RUN

POOL = ipaddress.ip_network('198.18.0.0/15')
#: Where nothing listens: DDS of domain 0 and a port of nobody; the heartbeats' is the VPN's alone.
CLOSED = (7400, 7410, HEARTBEAT_PORT, 9)
#: Packets to one port in a row: its socket can keep so many.
BATCH = 64
#: Times that the stranger takes new sockets.
ROUNDS = 10
#: Packets faster than the machine reads them, and packets to a socket that echoes.
FLOOD, CONTROL = 20_000, 640
#: WireGuard: lengths of the messages of types 1 to 3.
LENGTHS = {1: 148, 2: 92, 3: 64}
#: The ports of the robots' ROS domain.
DDS = range(dds_ports(DOMAIN)[0], dds_ports(DOMAIN)[1] + 1)
Address = tuple[str, int]


@dataclasses.dataclass(frozen=True)
class Port:
    """An open socket; ``dropped`` in packets."""

    kind: str
    number: int
    inode: int
    dropped: int


@dataclasses.dataclass
class Outcome:
    """
    What strangers got.

    :param ports: UDP ports that were open on machine and robot.
    :param replies: how many came from each address and port of machine and robot.
    :param cookies: cookie replies of WireGuard.
    :param accepted: TCP ports that accept connections, and did not before or by design.
    :param control: replies of sockets that echo, on machine and robot.
    :param dropped: packets that the kernel dropped before a program read them, the flood aside.
    :param problems: of the machine afterwards.
    """

    ports: list[str] = dataclasses.field(default_factory=list)
    sent: int = 0
    replies: Counter[str] = dataclasses.field(default_factory=Counter)
    cookies: int = 0
    accepted: list[str] = dataclasses.field(default_factory=list)
    control: list[int] = dataclasses.field(default_factory=list)
    dropped: int = 0
    problems: list[str] = dataclasses.field(default_factory=list)


def open_ports(process: int, *, tcp: bool = True) -> list[Port]:
    """Return the sockets of a process's network that a stranger can send to; TCP takes longer."""
    found = []
    for table in ('udp', 'udp6', *(('tcp', 'tcp6') if tcp else ())):
        for line in Path(f'/proc/{process}/net/{table}').read_text().splitlines()[1:]:
            words = line.split()
            text, _, port = words[1].partition(':')
            data = b''.join(bytes.fromhex(text[at:at + 8])[::-1] for at in range(0, len(text), 8))
            address = ipaddress.ip_address(data)
            address = getattr(address, 'ipv4_mapped', None) or address
            # listening, or without a peer
            if words[3] == {'tcp': '0A', 'udp': '07'}[table[:3]] and not address.is_loopback \
                    and address not in POOL:
                found.append(Port(table[:3], int(port, 16), int(words[9]),
                                  int(words[12]) if table[:3] == 'udp' else 0))
    return found


def own_inodes(mark: str) -> set[int]:
    """Return the sockets of the processes that a launch started."""
    found = set()
    for process in Path('/proc').glob('[0-9]*'):
        with contextlib.suppress(OSError):
            if mark.encode() in (process / 'environ').read_bytes():
                links = (os.readlink(each) for each in (process / 'fd').iterdir())
                found |= {int(link[8:-1]) for link in links if link.startswith('socket:[')}
    return found


def outside(process: int) -> str:
    """Return the network of the nearest parent process that is in another one."""
    own = os.readlink(f'/proc/{process}/ns/net')
    while os.readlink(f'/proc/{process}/ns/net') == own:
        status = Path(f'/proc/{process}/status').read_text()
        process = int(status.partition('PPid:')[2].split()[0])
    return f'/proc/{process}/ns/net'


@contextlib.contextmanager
def captured(network: str) -> Iterator[dict[int, list[bytes]]]:
    """Capture UDP packets of a network namespace; yield them by their ports, both ends'."""
    sniffer = made_in(network, lambda: socket.socket(
        socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(3)))
    sniffer.settimeout(0.2)
    found: dict[int, list[bytes]] = defaultdict(list)
    done = threading.Event()

    def work() -> None:
        while not done.is_set():
            with contextlib.suppress(TimeoutError):
                data = sniffer.recv(2000)
                header = 4 * (data[0] & 15)
                if data[0] >> 4 == 4 and data[9] == socket.IPPROTO_UDP:
                    for at in (header, header + 2):
                        packets = found[int.from_bytes(data[at:at + 2], 'big')]
                        if len(packets) < 1000:
                            packets.append(data[header + 8:])

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield found
    finally:
        done.set()
        thread.join()
        sniffer.close()


def wireguard(dice: random.Random, key: bytes = b'', kind: int = 0) -> bytes:
    """Return a WireGuard message of random contents; with the receiver's key, mac1 is right."""
    kind = kind or dice.randint(1, 2 if key else 4)
    data = bytes([kind, 0, 0, 0]) + dice.randbytes(
        LENGTHS.get(kind, 32 + 16 * dice.randrange(80)) - 4)
    if not key:
        return data
    own = hashlib.blake2s(b'mac1----' + key).digest()
    return data[:-32] + hashlib.blake2s(data[:-32], digest_size=16, key=own).digest() + bytes(16)


def mutated(dice: random.Random, data: bytes) -> bytes:
    """Return a packet with some other bits, or cut."""
    if not data or dice.random() < 0.2:
        return data[:dice.randrange(len(data) + 1)]
    changed = bytearray(data)
    for _ in range(dice.randint(1, 8)):
        changed[dice.randrange(len(changed))] ^= 1 << dice.randrange(8)
    return bytes(changed)


def packets(
    dice: random.Random, key: bytes, real: Sequence[Sequence[bytes]],
) -> Iterator[bytes]:
    """Yield random packets, malformed ones, and real ones again, as they were and changed."""
    while True:
        yield dice.randbytes(dice.randrange(1400))
        yield wireguard(dice)
        yield wireguard(dice, key)
        yield dice.choice(dice.choice(real))
        yield mutated(dice, dice.choice(dice.choice(real)))


def dds(dice: random.Random, address: str) -> list[bytes]:
    """Return messages of a participant that claims an address, and wants an answer there."""
    found = []
    for port in (7400, 7410, 7411):
        one = rtps.Participant()
        found += [
            one.message(one.announcement([rtps.locator(address, port)])),
            one.message(rtps.heartbeat(rtps.SEDP, 1, 1), rtps.data(
                rtps.SEDP, 1, dice.randbytes(60)))]
        one.socket.close()
    return found


class Stranger:
    """
    Sends from a network namespace.

    :param process: whose network is the target's; its sockets are not sent more than they keep.
    """

    def __init__(self, network: str, process: int, dice: random.Random, outcome: Outcome) -> None:
        self.network, self.process, self.dice, self.outcome = network, process, dice, outcome
        self.seen: Counter[str] = Counter()

    def send(
        self, targets: Sequence[Address], count: int, stream: Iterator[bytes], *,
        paced: bool = True,
    ) -> int:
        """Send packets from new sockets; return how many replies came, cookies aside."""
        before = self.seen.total()
        with contextlib.ExitStack() as stack, selectors.DefaultSelector() as chosen:
            mine = [stack.enter_context(made_in(self.network, lambda: socket.socket(
                socket.AF_INET, socket.SOCK_DGRAM))) for _ in targets]
            for each in mine:
                each.bind(('', 0))
                chosen.register(each, selectors.EVENT_READ)
            for _ in range(0, count, BATCH):
                at = self.dice.randrange(len(targets))
                if paced:
                    self._wait(targets[at][1])
                for data in itertools.islice(stream, BATCH):
                    mine[at].sendto(data, targets[at])
                self._read(chosen, 0.0)
            while self._read(chosen, 1.0):
                pass  # until none came for a second
        return self.seen.total() - before

    def _wait(self, port: int) -> None:
        for _ in range(50):
            text = ''.join(Path(f'/proc/{self.process}/net/{table}').read_text()
                           for table in ('udp', 'udp6'))
            # of its sockets, none has bytes to be read
            if all(':00000000 00:' in line for line in text.splitlines()
                   if f':{port:04X} ' in line):
                return
            time.sleep(0.002)

    def _read(self, chosen: selectors.BaseSelector, timeout: float) -> bool:
        ready = chosen.select(timeout)
        for key, _ in ready:
            assert isinstance(key.fileobj, socket.socket)
            with contextlib.suppress(BlockingIOError):
                while True:
                    data, (host, port) = key.fileobj.recvfrom(2000, socket.MSG_DONTWAIT)
                    if data[:4] == b'\3\0\0\0' and len(data) == LENGTHS[3]:
                        self.outcome.cookies += 1
                    else:
                        self.seen[f'{host}:{port}'] += 1
        return bool(ready)

    def storm(
        self, hosts: Sequence[str], ports: Sequence[int], vpn: Address, key: bytes,
        real: Sequence[Sequence[bytes]], count: int,
    ) -> None:
        """Send all kinds of packets to all ports of a host, and add to the outcome."""
        with echo(f'/proc/{self.process}/ns/net') as control:
            stream = packets(self.dice, key, real)
            answered = {
                host: self.send([(host, control)], CONTROL, stream) for host in hosts}
        self.outcome.control.append(sum(answered.values()))
        hosts = [host for host in hosts if answered[host]]
        self.seen.clear()
        before = self._dropped(ports)
        # most packets go to open ports
        opened = {vpn, *((host, port) for host in hosts for port in ports)}
        targets = [*4 * sorted(opened), *((host, port) for host in hosts for port in CLOSED)]
        for _ in range(ROUNDS):
            self.send(targets, count // ROUNDS, stream)
        self.outcome.dropped += self._dropped(ports) - before
        # WireGuard sends cookies when it has too many handshakes
        self.send([vpn], FLOOD, iter(lambda: wireguard(self.dice, key, 1), b''), paced=False)
        self.outcome.sent += count + FLOOD
        self.outcome.replies += self.seen

    def _dropped(self, ports: Sequence[int]) -> int:
        return sum(each.dropped for each in open_ports(self.process, tcp=False)
                   if each.number in ports)


@contextlib.contextmanager
def echo(network: str) -> Iterator[int]:
    """Open a UDP socket that replies to everybody; yield its port."""
    own = made_in(network, lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    own.bind(('', 0))
    own.settimeout(0.2)
    done = threading.Event()

    def work() -> None:
        while not done.is_set():
            with contextlib.suppress(TimeoutError):
                own.sendto(*own.recvfrom(2000))

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield own.getsockname()[1]
    finally:
        done.set()
        thread.join()
        own.close()


def read(words: Sequence[str]) -> str:
    """Return what a command prints."""
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=True).stdout


def attack(here: Place, count: int, seed: int) -> Outcome:
    """Launch a machine; send it so many packets, and a quarter of that to the robot."""
    name, dice = f'strangers{secrets.token_hex(3)}', random.Random(seed)
    before = open_ports(here.computer.process) if isinstance(here, Host) else []
    by_design = {('tcp', 22)} if isinstance(here, Container) else {
        (each.kind, each.number) for each in before}
    with contextlib.ExitStack() as stack, robot(here, name) as its, \
            captured(here.network) as packets_of:
        run = its.launch()
        try:
            run.wait_for(UP, timeout=180.0)
            agent, _ = wait_until(lambda: agent_of(name), timeout=10.0, what='the agent')
            wait_until(lambda: any(each.number in DDS for each in open_ports(agent, tcp=False)),
                       timeout=30.0, what="the node's ports")
            # a neighbour of the robot; its own containers may not reach it
            beside = f'/proc/{agent}/ns/net'
            if isinstance(here, Boxed):
                beside = f'{here.network[:-1]}x'
            elif isinstance(here, Container):
                beside = f'/proc/{stack.enter_context(computer()).process}/ns/net'
            outcome = _attacked(
                here, its, run, agent, beside, packets_of, by_design, count, dice)
            run.interrupt()
            run.ended(120.0)
        finally:
            run.kill()
            here.clear(name)
    return outcome


def _attacked(
    here: Place, its: Robot, run: Launched, agent: int, beside: str,
    packets_of: dict[int, list[bytes]], by_design: set[tuple[str, int]], count: int,
    dice: random.Random,
) -> Outcome:
    outcome, record = Outcome(), its.record()
    name, listens = record['robot_vpn']['name'], int(record['robot_vpn']['port'])
    ((_, endpoint),) = [line.split() for line in read(
        [*here.prefix, 'wg', 'show', name, 'endpoints']).splitlines()]
    host, _, port = endpoint.rpartition(':')
    here.admit(its.name)
    addresses = json.loads(read(['nsenter', '-n', '-t', str(agent), 'ip', '-j', '-4', 'address']))
    hosts = list(dict.fromkeys([host, *(
        one['local'] for each in addresses for one in each['addr_info']
        if ipaddress.ip_address(one['local']) not in POOL and each['ifname'] != 'lo')]))
    machine = [each for each in open_ports(agent) if (each.kind, each.number) not in by_design]
    mine = own_inodes(f'{RUN}={its.environment[RUN]}')
    own = [each for each in open_ports(run.child.pid)
           if each.inode in mine or (each.kind, each.number) == ('udp', listens)]
    (route,) = json.loads(read([*here.prefix, 'ip', '-j', 'route', 'get', host]))
    address = str(route['prefsrc'])
    beats = [data for data in packets_of[HEARTBEAT_PORT] if data]
    real = [packets_of[int(port)] or packets_of[listens], beats or [b''], dds(dice, address),
            [sign(secrets.token_hex(32), BEAT.pack(10**9 + at, float(at))) for at in range(50)]]
    print(f'{its.place.kind}: {hosts} {machine}, robot {address} {own}, '
          f'real packets {[len(each) for each in real]}')
    source = outside(agent) if isinstance(here, Pod) else here.network
    for network, process, at, ports, vpn, amount, key in (
            (source, agent, hosts, machine, (host, int(port)), count, record['public_key']),
            (beside, run.child.pid, [address], own, (address, listens), count // 4,
             read([*here.prefix, 'wg', 'show', name, 'public-key']))):
        numbers = sorted({each.number for each in ports if each.kind == 'udp'})
        outcome.ports += [f'{one}:{number}' for one in at[:1] for number in numbers]
        Stranger(network, process, dice, outcome).storm(
            at, numbers, vpn, base64.b64decode(key), real, amount)
        outcome.accepted += [
            f'{one}:{each.number}' for one in at for each in open_ports(process)
            if each.kind == 'tcp' and (each in ports or process == agent)
            and (each.kind, each.number) not in by_design and answers(network, one, each.number)]
    told = ros2('fog', 'status', its.name, '--json', environment=its.environment, timeout=60.0,
                prefix=here.prefix)
    outcome.problems += ['launch ended'] if run.child.poll() is not None else []
    status: dict[str, Any] = json.loads(told.stdout) if told.stdout else {}
    outcome.problems += status.get('problems', [told.stderr])
    if not (status.get('vpn') or {}).get('latency'):
        outcome.problems.append(f"VPN: {status.get('vpn')}")
    return outcome
