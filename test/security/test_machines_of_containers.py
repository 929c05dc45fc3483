# SPDX-License-Identifier: Apache-2.0
"""Container machines that attack the robot past the VPN, over the bridge of their network."""

from __future__ import annotations

from collections.abc import Iterator
import ipaddress
import json
import os
import selectors
import socket
import struct
import threading

import pytest

from fogros2.model import Command, Machine
from fogros2.process import run
from fogros2.provider import container
from fogros2.provider.container import machine as container_machine
from fogros2.shell.ssh import SSHShell
from fogros2.waiting import wait_until
from rigs.container_machines import Cloud, cloud, cloud_network, clouds, engine, key

__all__ = ['cloud', 'cloud_network', 'clouds', 'engine', 'key']

#: Podman's default network, which publishes ports.
DEFAULT = 'podman'
GROUPS = '239.255.0.1', 'ff02::1'
#: Root on the machine sends words to each host and port, by TCP and by UDP: as it is, then with
#: an address that it gives itself, then with such a link address too.
ATTACK = """
import socket, subprocess, sys
gateway, stolen, *targets = sys.argv[1:]

def ip(*words):
    subprocess.run(['ip', *words], check=True)

def send(state):
    for target in targets:
        host, _, port = target.rpartition(' ')
        for kind in socket.SOCK_STREAM, socket.SOCK_DGRAM:
            family, _, _, _, at = socket.getaddrinfo(host, int(port), type=kind)[0]
            with socket.socket(family, kind) as one:
                one.settimeout(0.15)
                try:
                    one.connect(at)
                    one.send(f'{state} {kind.name} {host}'.encode())
                    if one.recv(99):
                        print(state, kind.name, 'answered by', target, flush=True)
                except OSError:
                    pass

ip('route', 'replace', 'default', 'via', gateway)
send('plain')
ip('address', 'add', stolen, 'dev', 'eth0')
ip('route', 'replace', 'default', 'via', gateway, 'src', stolen.partition('/')[0])
send('stolen address')
ip('link', 'set', 'eth0', 'address', '02:00:00:00:be:ef')
ip('route', 'replace', 'default', 'via', gateway)
send('stolen link address')
"""
#: Prints the size of the answer to a query for the root's name servers.
ASK = """
import socket, sys
one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
one.settimeout(60)
one.sendto(bytes.fromhex('0001010000010000000000000000020001'), (sys.argv[1], 53))
print(len(one.recv(4096)))
"""
METADATA = '169.254.169.254'
#: Answers at the ports of a metadata service and of DNS.
SERVICE = """
import selectors, socket
chosen = selectors.DefaultSelector()
for port, kind in ((80, socket.SOCK_STREAM), (53, socket.SOCK_DGRAM)):
    one = socket.socket(socket.AF_INET, kind)
    one.bind(('169.254.169.254', port))
    if port == 80:
        one.listen()
    chosen.register(one, selectors.EVENT_READ, port)
while True:
    for key, _ in chosen.select():
        if key.data == 80:
            with key.fileobj.accept()[0] as link:
                link.send(b'token')
        else:
            key.fileobj.sendto(b'name', key.fileobj.recvfrom(99)[1])
"""
#: Prints the ports of that service which answer.
ASK_SERVICE = """
import socket, sys
for port, kind in ((80, socket.SOCK_STREAM), (53, socket.SOCK_DGRAM)):
    with socket.socket(socket.AF_INET, kind) as one:
        one.settimeout(2)
        try:
            one.connect((sys.argv[1], port))
            one.send(b'query')
            if one.recv(9):
                print(port)
        except OSError:
            pass
"""


class Robot:
    """Services of the robot at one port of all its addresses; they note what comes."""

    def __init__(self) -> None:
        self.heard: list[str] = []
        self._end, self._ended = socket.socketpair()
        self._sockets = [socket.create_server(('::', 0), family=socket.AF_INET6,
                                              dualstack_ipv6=True)]
        self.port: int = self._sockets[0].getsockname()[1]
        for family, host in ((socket.AF_INET, '0.0.0.0'), (socket.AF_INET6, '::')):
            one = socket.socket(family, socket.SOCK_DGRAM)
            if family is socket.AF_INET6:
                one.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            one.bind((host, self.port))
            self._sockets.append(one)
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def join(self, bridge: str) -> None:
        """Hear multicast that comes over a bridge."""
        index = socket.if_nametoindex(bridge)
        self._sockets[1].setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, struct.pack(
            '4s4si', socket.inet_aton(GROUPS[0]), bytes(4), index))

    def _serve(self) -> None:
        with selectors.DefaultSelector() as chosen:
            for one in (*self._sockets, self._ended):
                chosen.register(one, selectors.EVENT_READ)
            while True:
                for found, _ in chosen.select():
                    one = found.fileobj
                    assert isinstance(one, socket.socket)
                    if one is self._ended:
                        return
                    if one is self._sockets[0]:
                        connection, _ = one.accept()
                        with connection:
                            connection.settimeout(60.0)
                            self.heard.append(connection.recv(99).decode())
                    else:
                        self.heard.append(one.recv(99).decode())

    def close(self) -> None:
        self._end.close()
        self._thread.join(60.0)
        for one in (*self._sockets, self._ended):
            one.close()


@pytest.fixture
def robot() -> Iterator[Robot]:
    """Run services on all addresses of this computer for the time of a test."""
    made = Robot()
    yield made
    made.close()


def bridge_of(network: str) -> tuple[str, str, str]:
    """Return this computer's interface and IPv4 address in a network of podman, and the subnet."""
    told = json.loads(run(Command(('podman', 'network', 'inspect', network), sudo=True),
                          timeout=60).stdout)[0]
    subnet = told['subnets'][0]
    return told['network_interface'], subnet['gateway'], subnet['subnet']


def addresses(interface: str = '') -> list[tuple[str, str]]:
    """Return families and addresses of this computer, or of one interface."""
    told = json.loads(run(Command(('ip', '-j', 'address', 'show', *(
        ('dev', interface) if interface else ('up',)))), timeout=60).stdout)
    return [(each['family'], each['local']) for link in told for each in link.get('addr_info', ())]


def attack(robot: Robot, shell: SSHShell, network: str, *targets: str) -> str:
    """Attack the robot from a machine; return what answered."""
    bridge, gateway, subnet = bridge_of(network)
    robot.join(bridge)
    own = {address for family, address in addresses() if family == 'inet'} - {'127.0.0.1'}
    links = [address for family, address in addresses(bridge) if family == 'inet6']
    assert gateway in own and links
    # the last address of the network is nobody's: engines count up
    stolen = ipaddress.ip_network(subnet)[-2]
    hosts = [*sorted(own), *(f'{link}%eth0' for link in links), GROUPS[0], f'{GROUPS[1]}%eth0']
    return shell.run(Command(
        ('python3', '-c', ATTACK, gateway, f'{stolen}/32',
         *(f'{host} {robot.port}' for host in hosts), *targets), sudo=True), timeout=90).stdout


@pytest.fixture(scope='module')
def published() -> int:
    """Return a port below those that programs get."""
    return 20000 + os.getpid() % 10000


@pytest.fixture(scope='module')
def pair(clouds: Cloud, published: int) -> Iterator[tuple[Machine, SSHShell, SSHShell]]:
    """Return a machine with a published port and its shell, and the shell of another machine."""
    with clouds.machine(options={'network': '', 'ports': [f'{published}:22']}) as (one, far), \
            clouds.machine(options={'network': ''}) as (_, shell):
        yield one, far, shell


def test_machine_gets_dns_and_no_token_from_a_cloud(
        pair: tuple[Machine, SSHShell, SSHShell]) -> None:
    """Another machine has the address of clouds' metadata services, and this computer a route."""
    service, far, shell = pair
    assert service.endpoint is not None
    far.run(Command(('ip', 'address', 'add', f'{METADATA}/32', 'dev', 'lo'), sudo=True),
            timeout=60)
    far.run(Command(('sh', '-c', 'python3 -c "$1" >/dev/null 2>&1 &', 'sh', SERVICE), sudo=True),
            timeout=60)
    route = METADATA, 'via', service.endpoint.host
    run(Command(('ip', 'route', 'add', *route), sudo=True), timeout=60)
    try:
        ask = Command(('python3', '-c', ASK_SERVICE, METADATA))
        wait_until(lambda: run(ask, timeout=60).stdout.split() == ['80', '53'], timeout=60,
                   what='the service')
        assert shell.run(ask, timeout=60).stdout.split() == ['53']
    finally:
        run(Command(('ip', 'route', 'del', *route), sudo=True), timeout=60)


def test_machine_reaches_no_port_of_the_robot(
        pair: tuple[Machine, SSHShell, SSHShell], robot: Robot, published: int) -> None:
    other, _, shell = pair
    assert other.endpoint is not None
    _, gateway, _ = bridge_of(DEFAULT)
    said = attack(robot, shell, DEFAULT, f'{other.endpoint.host} 22', f'{gateway} {published}')
    assert robot.heard == []
    # the other machine itself answers, but not at the port that the robot lends it
    assert said.splitlines() == [
        f'{state} SOCK_STREAM answered by {other.endpoint.host} 22'
        for state in ('plain', 'stolen address', 'stolen link address')]


def test_started_machine_reaches_dns_and_no_other_port(
        cloud: Cloud, robot: Robot, cloud_network: str) -> None:
    machine = cloud.reached(cloud.create(cloud.spec(on_exit='stop')))
    cloud.provider.stop(machine.id)
    name = container.filter_name(container_machine.directory(machine.id.split(':')[2]))
    assert name not in cloud.traces(), 'the filter stays'
    cloud.provider.start(machine.id)
    gateway = bridge_of(cloud_network)[1]
    with cloud.shell(cloud.reached(machine.id)) as shell:
        shell.run(Command(('ping', '-c1', '-W5', gateway)), timeout=60)
        assert int(shell.run(Command(('python3', '-c', ASK, gateway)), timeout=60).stdout) > 11
        attack(robot, shell, cloud_network)
        assert robot.heard == []
