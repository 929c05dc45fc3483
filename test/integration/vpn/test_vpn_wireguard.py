# SPDX-License-Identifier: Apache-2.0
"""WireGuard between two hosts: up, down, killed, moved, and what a hijacked machine reaches."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import os
from pathlib import Path
import stat
import sys

import pytest

from fogros2 import process
from fogros2.dds.zenoh import Zenoh
from fogros2.deploy.steps.arming import cause, route_to
from fogros2.errors import CommandError
from fogros2.model import Command, Peer
from fogros2.vpn import addresses
from fogros2.vpn.wireguard import WireGuard
from fogros2.waiting import wait_until
from rigs.vpn_lab import Lab, MACHINE, opened, ROBOT

#: Answers UDP at ports 7411 (DDS's) and 9000, and TCP at 22, of the addresses given.
SERVER = '''
import itertools, selectors, socket, sys
chosen = selectors.DefaultSelector()
kinds = (socket.SOCK_DGRAM, 7411), (socket.SOCK_DGRAM, 9000), (socket.SOCK_STREAM, 22)
for address, (kind, port) in itertools.product(sys.argv[1:], kinds):
    one = socket.socket(socket.AF_INET, kind)
    one.bind((address, port))
    if kind == socket.SOCK_STREAM:
        one.listen()
    chosen.register(one, selectors.EVENT_READ)
print('{"ready": true}', flush=True)
while True:
    for key, _ in chosen.select():
        if key.fileobj.type == socket.SOCK_STREAM:
            key.fileobj.accept()[0].close()
        else:
            data, sender = key.fileobj.recvfrom(100)
            key.fileobj.sendto(data, sender)
'''
#: Prints which of its arguments (udp:host:port, tcp:host:port) answer within three seconds.
CLIENT = '''
import select, socket, sys, time
waiting = {}
for word in sys.argv[1:]:
    kind, host, port = word.split(':')
    one = socket.socket(type=socket.SOCK_DGRAM if kind == 'udp' else socket.SOCK_STREAM)
    one.setblocking(False)
    try:
        one.connect((host, int(port)))
    except BlockingIOError:
        pass
    if kind == 'udp':
        one.send(b'x')
    waiting[one] = word
end = time.monotonic() + 3.0
while waiting and time.monotonic() < end:
    streams = [one for one in waiting if one.type == socket.SOCK_STREAM]
    readable, writable, _ = select.select(list(waiting), streams, [], 0.05)
    for one in {*readable, *writable}:
        word = waiting.pop(one)
        if not one.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            print(word)
'''


def traces(lab: Lab, host: str) -> list[str]:
    """Return what an interface has made on a host."""
    interface = lab.interfaces[host]
    found = [name for name in lab.shell(host, 'ls /sys/class/net').split()
             if name == interface.name]
    found += [line for line in lab.shell(host, 'nft list tables').splitlines()
              if interface.name in line]
    found += [str(path) for path in Path('/var/run/wireguard').glob(f'{interface.name}*')]
    found += [str(path) for path in Path(interface.key_file).parent.glob('*')]
    found += [str(path) for path in Path('/run').glob(f'{interface.name}*')]
    return found + ([f'process {lab.wireguard_go(host)}'] if lab.wireguard_go(host) else [])


def test_up_carries_and_down_leaves_nothing_of_ours(vpn: Lab, tmp_path: Path) -> None:
    """A wireguard-go ends itself when its socket goes: a stopped one shows that down ends it."""
    assert vpn.ping('robot', MACHINE) and vpn.ping('machine', ROBOT)
    assert vpn.alive('robot') and vpn.alive('machine')
    program = tmp_path / 'wireguard-go'
    program.write_text('#!/bin/sh\necho "{\\"ready\\": true}"\nread -r end\n')
    program.chmod(0o755)
    others = {host: vpn.start(host, [str(program), vpn.interfaces['robot'].name])
              for host in ('lan', 'robot')}
    for other in others.values():
        other.wait('ready')
    for host, interface in vpn.interfaces.items():
        assert traces(vpn, host)
        running = vpn.wireguard_go(host)
        if running:  # this kernel has no WireGuard itself
            process.run(Command(('kill', '-STOP', str(running)), sudo=True), timeout=60.0)
        try:
            for _ in range(2):
                vpn.do(host, vpn.vpn.down(interface))
            wait_until(lambda host=host: not vpn.wireguard_go(host), timeout=10.0,
                       what='the end of the stopped wireguard-go')
        finally:
            if running:
                process.run(Command(('kill', '-CONT', str(running)), sudo=True), timeout=60.0,
                            check=False)
        assert traces(vpn, host) == []
    # of two others, the one in the robot's own network is ended
    wait_until(lambda: others['robot'].process.poll() is not None, timeout=10.0,
               what='the end of the wireguard-go in the same network')
    assert others['lan'].process.poll() is None


def test_full_packets_cross_a_path_that_loses_large_ones(lab: Lab) -> None:
    """As in mobile networks: 1400 bytes at the most, and no ICMP message about larger packets."""
    lab.link('robot', 'e9', '192.0.2.10/24', 'machine', 'e9', '192.0.2.11/24')
    for host in ('robot', 'machine'):
        lab.shell(host, 'nft "add table ip path; add chain ip path in { type filter hook '
                        'prerouting priority -500; }; add rule ip path in iifname e9 '
                        'meta length > 1400 drop"')
    lab.connect(f"192.0.2.11:{lab.interfaces['machine'].port}")
    wait_until(lambda: lab.ping('robot', MACHINE), timeout=20.0, what='an echo')
    lab.run('robot', Command(('ping', '-n', '-q', '-c1', '-i0.2', '-w8', '-s1300', MACHINE)))


def test_routing_rule_that_takes_the_vpns_packets_is_named(shared: Lab) -> None:
    """As Tailscale's with an exit node: its table has a default route, and comes first."""
    machine, robot = shared.interfaces['machine'], shared.interfaces['robot']

    def found(handshake: bool = True) -> str:
        return cause('lab', machine, robot, handshake=handshake, pool=addresses.POOL,
                     route=shared.run('robot', route_to(MACHINE)).stdout)

    assert shared.handshaken() and "a firewall of 'lab'" in found()
    assert found(handshake=False) == f'is UDP port {machine.port} open on the way there?'
    shared.shell('robot', 'ip link add other type veth peer name o1; ip link set other up')
    try:
        shared.shell('robot', 'ip link set o1 up; ip route add default dev other table 52; '
                              'ip rule add pref 5270 lookup 52')
        assert not shared.ping('robot', MACHINE, timeout=1.0)
        assert f'{MACHINE} dev other' in found()
        shared.shell('robot', found().partition('sudo ')[2])
        assert shared.ping('robot', MACHINE) and 'dev other' not in found()
    finally:
        shared.shell('robot', 'ip link delete other; ip rule delete pref 5270; '
                              'ip rule delete pref 100', check=False)


@pytest.fixture(scope='module')
def shared(tun: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """Have a VPN for tests that leave it as it is."""
    with opened(Lab(tmp_path_factory.mktemp('vpn'))) as vpn:
        vpn.connect()
        yield vpn


def test_up_again_changes_nothing_and_keeps_the_session(shared: Lab) -> None:
    vpn = shared
    def handshakes() -> list[object]:
        status = vpn.run('robot', vpn.vpn.status(vpn.interfaces['robot'])).stdout
        return [peer['handshake'] for peer in vpn.vpn.parse_status(status).values()]

    process_id, before = vpn.wireguard_go('robot'), handshakes()
    vpn.do('robot', vpn.vpn.up(vpn.interfaces['robot'], vpn.peers()['robot']))
    assert vpn.wireguard_go('robot') == process_id
    assert vpn.ping('robot', MACHINE)
    assert handshakes() == before
    assert vpn.shell('robot', f'nft list table inet {vpn.interfaces["robot"].name}').count(
        'chain ') == 6


def test_up_with_another_filter_keeps_the_known_lan(shared: Lab) -> None:
    interface, ports = shared.interfaces['robot'], shared.dds.ports
    shared.shell('robot', f'nft add element inet {interface.name} lan "{{ 192.168.77.2 }}"')
    shared.do('robot', WireGuard(ports, ['198.18.8.2']).up(interface, shared.peers()['robot']))
    rules = shared.shell('robot', f'nft list table inet {interface.name}')
    assert '192.168.77.2' in rules and '198.18.8.2' in rules
    shared.do('robot', shared.vpn.up(interface, shared.peers()['robot']))
    rules = shared.shell('robot', f'nft list table inet {interface.name}')
    assert '192.168.77.2' in rules and '198.18.8.2' not in rules


def test_up_takes_over_what_failed_and_killed_launches_left(lab: Lab) -> None:
    interface = lab.interfaces['machine']
    command = lab.vpn.keys(interface)
    public = [lab.run('machine', command).stdout for _ in range(2)]
    assert public[0] == public[1] and len(public[0].strip()) == 44
    # a step fails
    with pytest.raises(CommandError, match='set the VPN interface .* up failed'):
        lab.do('machine', lab.vpn.up(dataclasses.replace(interface, address='198.18.7.999'), []))
    lab.do('machine', lab.vpn.down(interface))
    assert traces(lab, 'machine') == []
    # a launch is killed after its first step
    lab.run('machine', command)
    lab.shell('machine', f'ip tuntap add dev {interface.name} mode tun; '
                         f'mkdir -p /var/run/wireguard; touch /var/run/wireguard/'
                         f'{interface.name}.sock')
    lab.connect()
    assert lab.ping('robot', MACHINE)
    path = Path(interface.key_file)
    if os.geteuid() == 0:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        private = path.read_text().strip()
        said = lab.run('machine', lab.vpn.status(interface)).stdout
        words = [' '.join(c.argv) for c in lab.vpn.up(interface, [])]
        assert all(private not in text for text in [said, *words])


def test_another_peer_doesnt_disturb_the_first(shared: Lab) -> None:
    vpn = shared
    interface = vpn.interfaces['robot']
    before = vpn.vpn.parse_status(vpn.run('robot', vpn.vpn.status(interface)).stdout)
    second = Peer('second', f'{"A" * 43}=', '198.18.7.3', '198.51.100.1:9')
    peers = [*vpn.peers()['robot'], second]
    vpn.do('robot', vpn.vpn.peers(interface, peers))
    assert vpn.ping('robot', MACHINE)
    after = vpn.vpn.parse_status(vpn.run('robot', vpn.vpn.status(interface)).stdout)
    assert len(after) == 2
    for key, peer in before.items():
        assert after[key]['handshake'] == peer['handshake']
        assert after[key]['received'] > peer['received']
    vpn.do('robot', vpn.vpn.peers(interface, [second]))
    assert not vpn.ping('robot', MACHINE, timeout=1.0)
    vpn.do('robot', vpn.vpn.peers(interface, vpn.peers()['robot']))


def test_networks_that_lead_to_no_machine_may_come_and_go(shared: Lab) -> None:
    vpn = shared
    space = vpn.spaces['robot']
    vpn.ip('-n', space, 'link', 'add', 'br7', 'type', 'bridge')
    vpn.ip('-n', space, 'address', 'add', '192.168.99.1/24', 'dev', 'br7')
    vpn.ip('-n', space, 'link', 'set', 'br7', 'up')
    assert vpn.alive('robot')
    vpn.repair('robot')
    vpn.ip('-n', space, 'link', 'delete', 'br7')
    assert vpn.alive('robot')
    # one that the packets to the machine leave by from now on
    vpn.ip('-n', space, 'address', 'add', '198.51.100.7/24', 'dev', 'e0')
    vpn.ip('-n', space, 'route', 'add', '198.51.100.1/32', 'dev', 'e0', 'src', '198.51.100.7')
    assert not vpn.alive('robot')
    vpn.repair('robot')
    assert vpn.alive('robot') and vpn.ping('robot', MACHINE, timeout=4.0)
    vpn.ip('-n', space, 'address', 'delete', '198.51.100.7/24', 'dev', 'e0')
    vpn.repair('robot')


def test_a_hijacked_machine_reaches_dds_and_ping_alone(vpn: Lab) -> None:
    vpn.lan()
    at_robot = [ROBOT, '192.168.77.1', '198.51.100.2']
    for host, at in (('robot', at_robot), ('lan', ['192.168.77.2']), ('machine', [MACHINE])):
        vpn.start(host, [sys.executable, '-c', SERVER, *at]).wait('ready')
    vpn.shell('robot', 'echo 1 >/proc/sys/net/ipv4/ip_forward')
    vpn.shell('lan', 'ip route add default via 192.168.77.1')
    # root there sends what it likes to whom it likes
    name = vpn.interfaces['machine'].name
    robot = vpn.peers()['machine'][0].public_key
    vpn.shell('machine', f'wg set {name} peer {robot} allowed-ips 0.0.0.0/0; '
                         f'ip route add 192.168.77.0/24 dev {name}; '
                         f'ip route add 198.51.100.0/24 dev {name}')
    targets = [f'{kind}:{address}:{port}'
               for address in (*at_robot, '192.168.77.2')
               for kind, port in (('udp', 7411), ('udp', 9000), ('tcp', 22))]

    def reached() -> list[str]:
        return vpn.run('machine', Command((sys.executable, '-c', CLIENT, *targets))
                       ).stdout.split()

    assert reached() == [f'udp:{ROBOT}:7411']
    assert vpn.ping('machine', ROBOT)
    assert not vpn.ping('machine', '192.168.77.2', timeout=1.0)
    # and the other way the robot is answered
    answered = vpn.run('robot', Command((
        sys.executable, '-c', CLIENT, f'udp:{MACHINE}:9000', f'tcp:{MACHINE}:22'))).stdout
    assert len(answered.split()) == 2
    # zenoh's nodes do not listen there, and the user's other nodes are not the launch's
    vpn.do('robot', WireGuard(Zenoh().ports).up(vpn.interfaces['robot'], vpn.peers()['robot']))
    assert reached() == []
    assert vpn.ping('machine', ROBOT)
    # without the filter all of it would be open, or this test would prove nothing
    vpn.shell('robot', f'nft delete table inet {vpn.interfaces["robot"].name}')
    assert sorted(reached()) == sorted(targets)


def test_flushed_filter_is_noticed_and_repaired(vpn: Lab) -> None:
    """As ``systemctl reload nftables`` flushes it on Debian and Ubuntu."""
    def complete(host: str) -> bool:
        return vpn.alive(host) and vpn.run(
            host, vpn.vpn.status(vpn.interfaces[host]), check=False).returncode == 0

    for host, interface in vpn.interfaces.items():
        assert complete(host)
        vpn.shell(host, 'nft flush ruleset')
        assert not complete(host)
        vpn.repair(host)
        assert complete(host)
        assert f'table inet {interface.name}' in vpn.shell(host, 'nft list tables')
    vpn.shell('machine', 'nft flush ruleset')
    wait_until(lambda: not vpn.alive('machine'), timeout=60,
               what='a check of the agent in a tenth second')


def test_removed_address_is_noticed_and_repaired(vpn: Lab) -> None:
    """As systemd-networkd removes it when it starts again, from all links that it manages."""
    for host, interface in vpn.interfaces.items():
        assert vpn.alive(host)
        vpn.shell(host, f'ip address flush dev {interface.name}')
        assert not vpn.alive(host)
        vpn.repair(host)
        assert vpn.alive(host)
    assert vpn.ping('machine', ROBOT)


def test_machine_with_an_address_of_the_vpn_is_reported(lab: Lab) -> None:
    interface = dataclasses.replace(lab.interfaces['machine'], host_routes=True)
    peers = lab.peers()['machine']
    for taken in (ROBOT, MACHINE):
        lab.link('machine', 'own0', f'{taken}/24', 'lan', 'own0', '198.18.7.201/24')
        with pytest.raises(CommandError, match=f'in use already: local {taken} dev own0'):
            lab.do('machine', lab.vpn.up(interface, peers))
        lab.ip('-n', lab.spaces['machine'], 'link', 'delete', 'own0')
