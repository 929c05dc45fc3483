# SPDX-License-Identifier: Apache-2.0
"""
A robot, a machine and the bad network between them, each in a network namespace.

::

    robot 198.51.100.2 --- .1  net (relay, no forwarding)  203.0.113.1 --- .2 machine
      | 192.168.77.1
    lan 192.168.77.2  (a second computer beside the robot)

The relay passes UDP on, as a NAT would, so that the machine can't dial the robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import dataclasses
import functools
import importlib.util
import itertools
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import threading
from typing import Any

import pytest

from fogros2 import process
from fogros2.dds import DdsVendor
from fogros2.dds.cyclonedds import CycloneDds
from fogros2.dds.fastdds import FastDds
from fogros2.model import Command, Peer, Result, VpnInterface
from fogros2.vpn.wireguard import WireGuard
from fogros2.waiting import wait_until

TEST = Path(__file__).parents[1]
RELAY = TEST / 'relay.py'
NODE = TEST / 'integration/vpn/dds_node.py'
#: Participants of Cyclone DDS without ROS 2, by the package cyclonedds.
CYCLONE = TEST / 'integration/vpn/cyclone_node.py'
#: What ROS 2 Jazzy itself configures for Cyclone DDS.
STOCK = ('<CycloneDDS><Domain><Discovery><ParticipantIndex>auto</ParticipantIndex>'
         '<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex></Discovery></Domain></CycloneDDS>')
CYCLONE_0_10 = TEST.parent / '.cache/cyclonedds-0.10'
NETWORK = '198.18.7.0/24'
ROBOT, MACHINE, SECOND = '198.18.7.1', '198.18.7.2', '198.18.7.3'
PORT = 51820
#: `ip netns exec` hides the control groups of the host; $1 is the group to be in, if it is there.
ENTER = """\
mount -t cgroup2 cgroup2 /sys/fs/cgroup
group=$(find /sys/fs/cgroup -type d -name "${1:-none}"); shift
[ -z "$group" ] || echo $$ >"$group/cgroup.procs"
exec "$@"
"""
#: What makes a node find its Python, its packages and its middleware.
PASSED = ('PATH', 'PYTHONPATH', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH', 'HOME', 'ROS_DISTRO',
          'ROS_VERSION', 'ROS_PYTHON_VERSION')
_numbers = itertools.count()


class Child:
    """A program in a namespace that prints JSON objects, one a line."""

    def __init__(self, argv: Sequence[str]) -> None:
        words = process.argv(Command(tuple(argv), sudo=True))
        self.process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
            # a group and no session of its own: sudo's ticket is the terminal's
            preexec_fn=os.setpgrp)
        self.said: list[dict[str, Any]] = []
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if not line.startswith('{'):
                continue
            with self._news:
                self.said.append(json.loads(line))
                self._news.notify_all()

    def wait(self, key: str, value: object = None, *, after: float = 0.0, count: int = 1,
             timeout: float = 60.0) -> list[dict[str, Any]]:
        """
        Return the first ``count`` lines with ``key`` (equal to ``value``), sent after a time.

        :param after: on the monotonic clock; compared with when the message was sent.
        """
        def found() -> list[dict[str, Any]]:
            return self.lines(key, value, after=after)

        with self._news:
            done = self._news.wait_for(lambda: len(found()) >= count, timeout)
            lines = found()
        assert done, f'{len(lines)} of {count} lines with {key} {value or ""} in {timeout} s'
        return lines[:count]

    def lines(
        self, key: str, value: object = None, *, after: float = 0.0,
    ) -> list[dict[str, Any]]:
        return [line for line in self.said
                if key in line and value in (None, line[key])
                and line.get('arrival', after) - line.get('latency', 0.0) >= after]

    def tell(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Send a line to a program that answers each with one, and return the answer."""
        assert self.process.stdin is not None
        begin = len(self.said)
        self.process.stdin.write(json.dumps(settings) + '\n')
        with self._news:
            assert self._news.wait_for(lambda: len(self.said) > begin, 60.0)
            return self.said[begin]

    def stop(self) -> None:
        if self.process.poll() is None:
            self.process.terminate()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(60)
        self._thread.join(2.0)
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()


def abandoned(listed: str) -> list[str]:
    """Return the hosts of killed runs of the tests, from the output of ``ip netns list``."""
    alive = {int(name) % 100000 for name in os.listdir('/proc') if name.isdigit()}
    return [name for name in (line.split()[0] for line in listed.splitlines() if line)
            if (mark := re.match(r'fogt(\d+)x\d+[a-z]$', name)) and int(mark[1]) not in alive]


class Lab:
    """
    The namespaces, and what runs in them.

    :param middleware: of the nodes: 'cyclonedds', 'cyclonedds 0.10', or 'fastdds' for ROS 2's.
    """

    def __init__(self, folder: Path, middleware: str = 'cyclonedds') -> None:
        self.folder = folder
        self.middleware = middleware
        self.dds: DdsVendor = FastDds() if middleware == 'fastdds' else CycloneDds()
        # the sockets of wireguard-go are the computer's, so names are unique there
        self.mark = f'fogt{os.getpid() % 100000}x{next(_numbers)}'
        self.spaces = {host: f'{self.mark}{host[0]}' for host in (
            'robot', 'machine', 'net', 'lan')}
        self.vpn = WireGuard(ports=self.dds.ports)
        self.interfaces = {
            'robot': VpnInterface(f'{self.mark}r', ROBOT, NETWORK, PORT,
                                  str(folder / 'r/vpn.key'), firewall=True),
            'machine': VpnInterface(f'{self.mark}m', MACHINE, NETWORK, PORT,
                                    str(folder / 'm/vpn.key'))}
        #: Environment variables of the robot's user.
        self.user: dict[str, str] = {}
        self.children: list[Child] = []
        self.relay: Child | None = None
        self.lan_name: str | None = None

    # the network

    def open(self) -> None:
        for space in abandoned(process.run(Command(('ip', 'netns', 'list')), timeout=60.0).stdout):
            self.remove(space, VpnInterface(space, ROBOT, NETWORK, PORT, str(self.folder / 'none'),
                                            firewall=True))
        for space in self.spaces.values():
            self.ip('netns', 'add', space)
            self.ip('-n', space, 'link', 'set', 'lo', 'up')
        self.link('robot', 'e0', '198.51.100.2/24', 'net', 'e0', '198.51.100.1/24')
        self.link('machine', 'e0', '203.0.113.2/24', 'net', 'e1', '203.0.113.1/24')

    def link(self, host: str, name: str, address: str, other: str, other_name: str,
             other_address: str) -> None:
        spaces = self.spaces
        self.ip('link', 'add', name, 'netns', spaces[host], 'type', 'veth',
                'peer', 'name', other_name, 'netns', spaces[other])
        for space, link, at in ((spaces[host], name, address),
                                (spaces[other], other_name, other_address)):
            self.ip('-n', space, 'address', 'add', at, 'dev', link)
            self.ip('-n', space, 'link', 'set', link, 'up')

    def lan(self) -> None:
        """Put a second computer beside the robot."""
        self.lan_name = 'lan0'
        self.link('robot', 'lan0', '192.168.77.1/24', 'lan', 'lan0', '192.168.77.2/24')

    def second(self) -> None:
        """Add a second machine to the VPN, beside the first."""
        self.spaces['second'] = f'{self.mark}s'
        self.ip('netns', 'add', self.spaces['second'])
        self.ip('-n', self.spaces['second'], 'link', 'set', 'lo', 'up')
        self.link('robot', 'e1', '198.51.100.130/26', 'second', 'e0', '198.51.100.131/26')
        self.link('machine', 'e1', '203.0.113.130/26', 'second', 'e1', '203.0.113.131/26')
        interface = VpnInterface(f'{self.mark}s', SECOND, NETWORK, PORT,
                                 str(self.folder / 's/vpn.key'))
        self.interfaces['second'] = interface
        key = self.run('second', self.vpn.keys(interface)).stdout.strip()
        peers = self.peers()
        first, robot = peers['robot'][0], peers['machine'][0]
        self.do('second', self.vpn.up(interface, [
            robot, dataclasses.replace(first, endpoint=f'203.0.113.130:{PORT}')]))
        self.do('machine', self.vpn.peers(self.interfaces['machine'], [
            robot, Peer('second', key, SECOND, f'203.0.113.131:{PORT}')]))
        self.do('robot', self.vpn.peers(self.interfaces['robot'], [
            first, Peer('second', key, SECOND, f'198.51.100.131:{PORT}')]))

    def close(self) -> None:
        for child in reversed(self.children):
            child.stop()
        for host, space in self.spaces.items():
            self.remove(space, self.interfaces.get(host))

    def remove(self, space: str, interface: VpnInterface | None) -> None:
        """Remove a host, with its end of the VPN."""
        for command in self.vpn.down(interface) if interface else ():
            process.run(dataclasses.replace(
                command, argv=('ip', 'netns', 'exec', space, 'sh', '-c', ENTER, 'sh', '',
                               *command.argv), sudo=True), timeout=60.0, check=False)
        process.run(Command(('ip', 'netns', 'delete', space), sudo=True),
                    timeout=60.0, check=False)

    def ip(self, *words: str) -> None:
        process.run(Command(('ip', *words), sudo=True), timeout=60.0)

    def argv(self, host: str, words: Sequence[str], group: str = '') -> tuple[str, ...]:
        return ('ip', 'netns', 'exec', self.spaces[host], 'sh', '-c', ENTER, 'sh', group, *words)

    def run(self, host: str, command: Command, *, check: bool = True) -> Result:
        """Run a command of the VPN's on a host."""
        return process.run(
            Command(self.argv(host, command.argv), sudo=True, input=command.input,
                    what=command.what),
            timeout=60.0, check=check)

    def shell(self, host: str, text: str, *, check: bool = True) -> str:
        return self.run(host, Command(('sh', '-c', text)), check=check).stdout

    # what runs in it

    def launch(self, host: str) -> None:
        """Start what stands for a host's launch; nodes that start later belong to it."""
        child = self.start(host, ['sh', '-c', 'echo "{\\"pid\\": $$}"; exec sleep 600'])
        self.interfaces[host] = dataclasses.replace(
            self.interfaces[host], process=str(child.wait('pid')[0]['pid']))

    def start(
        self, host: str, words: Sequence[str], *, group: str = '', **environment: str,
    ) -> Child:
        passed = {name: os.environ[name] for name in PASSED if name in os.environ}
        pairs = [f'{key}={value}' for key, value in {**passed, **environment}.items()]
        child = Child(self.argv(host, ['env', '-i', *pairs, *words], group))
        self.children.append(child)
        return child

    def bad(self, **settings: object) -> None:
        """Change what the relay does to packets."""
        assert self.relay is not None
        answer = self.relay.tell(settings)
        assert 'error' not in answer, answer

    def repair(self, host: str) -> None:
        self.do(host, self.vpn.repair(self.interfaces[host], self.peers()[host]))

    def alive(self, host: str) -> bool:
        command = self.vpn.health_check(self.interfaces[host])
        return self.run(host, command, check=False).returncode == 0

    def peers(self) -> dict[str, list[Peer]]:
        """Make the keys, and return each host's peers."""
        keys = {host: self.run(host, self.vpn.keys(interface)).stdout.strip()
                for host, interface in self.interfaces.items()}
        return {'robot': [Peer('machine', keys['machine'], MACHINE, f'198.51.100.1:{PORT}')],
                'machine': [Peer('robot', keys['robot'], ROBOT)]}

    def do(self, host: str, commands: Iterator[Command]) -> None:
        for command in commands:
            said = self.run(host, command).stdout
            assert said == '', said

    def connect(self, endpoint: str = '') -> None:
        """
        Set the VPN up as a deployment does: the robot, the machine, the robot's peer.

        :param endpoint: the machine's, where no relay stands before it.
        """
        self.launch('robot')
        peers = self.peers()
        if endpoint:
            peers['robot'] = [dataclasses.replace(peers['robot'][0], endpoint=endpoint)]
        else:
            self.relay = self.start('net', [
                sys.executable, str(RELAY), f'198.51.100.1:{PORT}', f'203.0.113.2:{PORT}',
                '--seed', '1'])
            self.relay.wait('listen')
        self.do('robot', self.vpn.up(self.interfaces['robot'], []))
        self.do('machine', self.vpn.up(self.interfaces['machine'], peers['machine']))
        self.do('robot', self.vpn.peers(self.interfaces['robot'], peers['robot']))
        wait_until(self.handshaken, timeout=60.0, what='the handshake')

    def handshaken(self) -> bool:
        interface = self.interfaces['robot']
        output = self.run('robot', self.vpn.status(interface)).stdout
        return any(peer['handshake'] for peer in self.vpn.parse_status(output).values())

    def carried(self, host: str) -> float:
        """Return the bytes that a host's VPN interface has carried, both ways."""
        output = self.run(host, self.vpn.status(self.interfaces[host])).stdout
        return sum(p['received'] + p['sent'] for p in self.vpn.parse_status(output).values())

    def wireguard_go(self, host: str) -> int:
        """Return the id of a host's wireguard-go, 0 where there is none."""
        name = self.interfaces[host].name
        for path in Path('/proc').glob('[0-9]*/cmdline'):
            try:
                if path.read_bytes().split(b'\0')[:2] == [b'wireguard-go', name.encode()]:
                    return int(path.parent.name)
            except OSError:
                continue
        return 0

    def configure(self, host: str) -> Mapping[str, str]:
        """Write what a deployment configures for a host's nodes; return their variables."""
        interface = self.interfaces[host]
        used = interface.address if self.dds.by_address else interface.name
        machines = [other.address for name, other in self.interfaces.items()
                    if not other.firewall and name != host]
        if interface.firewall:
            text = self.dds.render(
                self.dds.robot_interfaces(used, self.lan_name, self.user),
                machines if self.dds.asks_machines else [], self.user, quiet=host == 'guest')
        else:
            text = self.dds.render(self.dds.machine_interfaces(used), machines)
        path = self.folder / f'{host} {self.dds.file_name}'
        path.write_text(text)
        return self.dds.environment(str(path), {})

    def node(self, host: str, *words: str, stock: bool = False) -> Child:
        """
        Start a node and wait until it is there: see ``dds_node.py`` for the words.

        :param stock: without what a deployment configures.
        """
        if reason := missing(self.middleware):
            pytest.skip(reason)
        program = NODE if self.middleware == 'fastdds' else CYCLONE
        environment = {'RMW_IMPLEMENTATION': self.dds.rmw, 'ROS_LOG_DIR': str(self.folder),
                       **({'CYCLONEDDS_URI': STOCK} if stock else self.configure(host))}
        if self.middleware == 'cyclonedds 0.10':
            environment['PYTHONPATH'] = str(CYCLONE_0_10)
        child = self.start(host, [sys.executable, str(program), *words],
                           group='' if stock else self.interfaces[host].name, **environment)
        child.wait('ready', timeout=60.0)
        return child

    def ping(self, host: str, address: str, *, timeout: float = 4.0) -> bool:
        """Tell whether an echo comes back within some seconds; asks again and again."""
        seconds = max(1, round(timeout))
        words = ('ping', '-n', '-q', '-c1', '-i0.2', f'-w{seconds}', address)
        return self.run(host, Command(words), check=False).returncode == 0


@functools.cache
def missing(middleware: str) -> str:
    """Return why a middleware's nodes cannot run here, '' if they can."""
    if middleware == 'cyclonedds 0.10':
        return '' if CYCLONE_0_10.is_dir() else 'Cyclone DDS 0.10 could not be built here'
    if middleware == 'cyclonedds':
        return '' if importlib.util.find_spec('cyclonedds') else 'needs the package cyclonedds'
    said = subprocess.run(
        [sys.executable, '-c',
         'import rclpy; print(rclpy.get_rmw_implementation_identifier())'],
        env={**os.environ, 'RMW_IMPLEMENTATION': FastDds.rmw}, capture_output=True, text=True)
    return '' if said.stdout.strip() == FastDds.rmw else f'needs ROS 2 with {FastDds.rmw}'


@pytest.fixture
def middleware() -> str:
    """Return the middleware of the lab's nodes; files of tests have fixtures of their own."""
    return 'cyclonedds'


@contextlib.contextmanager
def opened(network: Lab) -> Iterator[Lab]:
    """Have the hosts in the block."""
    try:
        network.open()
        yield network
    finally:
        network.close()


@pytest.fixture
def lab(tmp_path: Path, tun: None, middleware: str) -> Iterator[Lab]:
    """Return hosts without a VPN, gone after the test."""
    with opened(Lab(tmp_path, middleware)) as network:
        yield network


@pytest.fixture
def vpn(lab: Lab) -> Lab:
    """Return hosts with the VPN between them."""
    lab.connect()
    return lab
