# SPDX-License-Identifier: Apache-2.0
"""
The network of a box: a router, the robot and one place for each instance; nothing leads out.

::

    robot 198.51.100.2 -- router 198.51.100.1 -- instance 198.51.100.10 and 198.51.100.130
                            (the API)         -- instance 198.51.100.11 and 198.51.100.131

Each is a network namespace, so no address of it exists outside, and boxes side by side don't
meet. The router enforces the security groups on what an instance is sent, remembers connections
as clouds do, and lets nobody dial the robot, as a home's NAT.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
import itertools
import threading
from typing import Optional

from fogros2 import process
from fogros2.model import Command
from rigs.computers import netns

#: Of TEST-NET-2 (RFC 5737): nobody's.
ROUTER = '198.51.100.1'
ROBOT = '198.51.100.2'
#: Where the robot is after it has moved.
ROBOT_ELSEWHERE = '198.51.100.3'
_FIRST, _LAST, _PRIVATE = 10, 119, 120
METADATA = '169.254.169.254'
#: How namespaces of boxes begin.
PREFIX = 'fogt'


@dataclasses.dataclass(frozen=True)
class Allowed:
    """
    What a cloud's firewall lets in.

    :param protocol: tcp, udp, icmp, or '-1' for all.
    :param ports: first and last; None for all.
    :param sources: networks in CIDR form.
    :param accept: False for what it keeps out, unless an earlier entry lets it in.
    """

    protocol: str
    ports: Optional[tuple[int, int]]
    sources: tuple[str, ...]
    accept: bool = True


@dataclasses.dataclass(frozen=True)
class Host:
    """An instance's place: its link at the router, its addresses, what may come in."""

    link: str
    public: str
    private: str
    network: str
    allowed: tuple[Allowed, ...] = ()


def rules(hosts: Sequence[Host]) -> str:
    """Return the router's rules (nftables) for these instances."""
    lines = ['table ip cloud', 'delete table ip cloud', 'table ip cloud {']
    for host in hosts:
        lines.append(f' chain {host.link} {{')
        for entry in host.allowed:
            verdict = 'accept' if entry.accept else 'drop'
            lines += [f'  ip saddr {source} {_what(entry)}{verdict}' for source in entry.sources]
        lines.append('  drop\n }')
    lines += [' chain forward {', '  type filter hook forward priority 0; policy drop;',
              '  ct state established,related accept']
    for host in hosts:
        inside = [other.link for other in hosts if other.network == host.network]
        near = ', '.join(f'"{link}"' for link in inside)
        lines += [f'  ip daddr {host.public} goto {host.link}',
                  f'  iifname {{ {near} }} ip daddr {host.private} goto {host.link}']
    return '\n'.join([*lines, ' }', '}', ''])


def _what(entry: Allowed) -> str:
    if entry.protocol == '-1':
        return ''
    if entry.protocol == 'icmp':
        return 'meta l4proto icmp '
    if entry.ports is None:
        return f'meta l4proto {entry.protocol} '
    first, last = entry.ports
    return f'{entry.protocol} dport {first}-{last} '


class Addresses:
    """Hands out addresses of the test network, and no others."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._next = itertools.cycle(range(_FIRST, _LAST + 1))
        self._taken: set[int] = set()

    def take(self, *, private: bool = False) -> str:
        """
        Return an address that isn't in use.

        :raises LookupError: all are.
        """
        with self._lock:
            for _ in range(_FIRST, _LAST + 1):
                number = next(self._next) + (_PRIVATE if private else 0)
                if number not in self._taken:
                    self._taken.add(number)
                    return f'198.51.100.{number}'
        raise LookupError('every address of the test network is in use')

    def give_back(self, addresses: Iterable[str]) -> None:
        """Make addresses free again."""
        with self._lock:
            self._taken -= {int(address.rpartition('.')[2]) for address in addresses}


class Network:
    """
    The namespaces of one box.

    :param mark: a few letters that no other box has.
    """

    def __init__(self, mark: str) -> None:
        self.router = f'{PREFIX}{mark}x'
        self.robot = f'{PREFIX}{mark}r'
        self._mark = mark
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)

    def open(self) -> None:
        """Make the router and the robot."""
        _run(f"""
            ip netns add {self.router}
            ip -n {self.router} link set lo up
            ip -n {self.router} address add {ROUTER}/32 dev lo
            ip netns exec {self.router} sysctl -qw net.ipv4.ip_forward=1
            ip netns add {self.robot}
            ip -n {self.robot} link set lo up
            ip link add eth0 netns {self.robot} type veth peer name robot netns {self.router}
            ip -n {self.router} link set robot up
            ip netns exec {self.router} sysctl -qw net.ipv4.conf.robot.proxy_arp=1
            ip -n {self.robot} link set eth0 up
            {self._robot_at(ROBOT)}
            """, 'make a network')
        self.protect([])

    def _robot_at(self, address: str) -> str:
        return f"""
            ip -n {self.robot} address add {address}/24 dev eth0
            ip -n {self.robot} route replace default via {ROUTER} dev eth0
            ip -n {self.router} route replace {address} dev robot
            """

    def move_robot(self, address: str) -> None:
        """Give the robot another address, as another network would."""
        _run(f"""
            ip -n {self.robot} address flush dev eth0
            {self._robot_at(address)}
            """, 'give the robot another address')

    def add(self) -> tuple[str, str]:
        """Make an empty namespace for an instance; return its name and its link's."""
        with self._lock:
            link = f'i{next(self._numbers)}'
        space = f'{PREFIX}{self._mark}{link}'
        _run(f"""
            ip netns add {space}
            ip -n {space} link set lo up
            ip -n {space} address add {METADATA}/32 dev lo
            ip link add eth0 netns {space} type veth peer name {link} netns {self.router}
            ip -n {self.router} link set {link} up
            ip -n {space} link set eth0 up
            """, 'make a place for an instance')
        return space, link

    def attach(self, space: str, host: Host) -> None:
        """Give a namespace its addresses."""
        _run(f"""
            ip -n {space} address add {host.public}/32 dev eth0
            ip -n {space} address add {host.private}/32 dev eth0
            ip -n {space} route add {ROUTER} dev eth0 src {host.public}
            ip -n {space} route add default via {ROUTER} dev eth0 src {host.public}
            ip -n {self.router} route add {host.public} dev {host.link}
            ip -n {self.router} route add {host.private} dev {host.link}
            """, 'give an instance its addresses')

    def answers(self, address: str, port: int) -> bool:
        """Return whether a TCP port of an instance takes a connection from the router."""
        return netns.answers(self.router, address, port)

    def protect(self, hosts: Sequence[Host]) -> None:
        """Put the router's rules in force, all at once."""
        with self._lock:
            process.run(Command(
                ('ip', 'netns', 'exec', self.router, 'nft', '-f', '-'), sudo=True,
                input=rules(hosts).encode(), what="put the router's rules in force"),
                timeout=60.0)

    def remove(self, space: str) -> None:
        """Take a namespace away, and its link with it."""
        # the link first: a namespace goes only when the last of its sockets has, and until then
        # its addresses would be where nobody is
        link = space.removeprefix(f'{PREFIX}{self._mark}')
        _run(f"""
            ip -n {self.router} link delete {link} || :
            ip netns delete {space} || :
            """, 'take a place away', check=False)

    def close(self) -> None:
        """Take everything away."""
        sweep(self._mark)


def sweep(mark: str) -> None:
    """Take the namespaces of the box ``mark`` away, and end what still runs in them."""
    text = process.run(Command(('ip', 'netns', 'list'), sudo=True), timeout=60.0,
                       check=False).stdout
    for line in text.splitlines():
        name = line.split()[0] if line.strip() else ''
        if name.startswith(f'{PREFIX}{mark}'):
            _run(f"""
                for pid in $(ip netns pids {name}); do kill -KILL $pid || :; done
                ip netns delete {name}
                """, 'take a network away', check=False)


def _run(script: str, what: str, *, check: bool = True) -> None:
    process.run(Command.script(script, sudo=True, what=what), timeout=30.0, check=check)
