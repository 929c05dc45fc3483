# SPDX-License-Identifier: Apache-2.0
"""Guests of a machine: what they reach, and who gets no answer at all."""

from __future__ import annotations

from pathlib import Path
import sys

from fogros2.model import Command
from fogros2.waiting import wait_until
from fogros2_features.guests import network
from fogros2_features.guests import program as guests
from rigs.container_machines import Cloud, cloud, cloud_network, engine, key
from rigs.vpn_guest import GUEST, Guest, guest
from rigs.vpn_lab import Child, Lab, MACHINE, ROBOT

__all__ = ['cloud', 'cloud_network', 'engine', 'guest', 'key']

#: Prints what arrives at its arguments, KIND:HOST:PORT.
LISTENER = '''
import json, selectors, socket, sys
chosen = selectors.DefaultSelector()
for word in sys.argv[1:]:
    kind, host, port = word.split(':')
    one = socket.socket(type=socket.SOCK_STREAM if kind == 'tcp' else socket.SOCK_DGRAM)
    one.bind((host, int(port)))
    if kind == 'tcp':
        one.listen()
    chosen.register(one, selectors.EVENT_READ, word)
print(json.dumps({'ready': True}), flush=True)
while True:
    for key, _ in chosen.select():
        said = key.fileobj.accept()[1][0] if key.data[0] == 't' else key.fileobj.recv(99).decode()
        print(json.dumps({'at': key.data, 'said': said}), flush=True)
'''
#: Tries to reach all its arguments at once.
SENDER = '''
import select, socket, sys, time
waiting = []
for word in sys.argv[1:]:
    kind, host, port = word.split(':')
    one = socket.socket(type=socket.SOCK_STREAM if kind == 'tcp' else socket.SOCK_DGRAM)
    one.setblocking(False)
    try:
        one.connect((host, int(port)))
        one.send(host.encode())
    except BlockingIOError:
        waiting.append(one)
    except OSError:
        pass
end = time.monotonic() + 1.5
while waiting and time.monotonic() < end:
    for one in select.select([], waiting, [], 0.1)[1]:
        waiting.remove(one)
'''
#: The last one is for the heartbeats of another guest.
PORTS = ['tcp:0.0.0.0:22', 'tcp:0.0.0.0:8765', 'udp:0.0.0.0:7399', 'udp:0.0.0.0:53',
         f"udp:0.0.0.0:{network.heartbeats('198.18.7.225')}"]
DDS = 'udp:0.0.0.0:7410'
#: What a guest reaches besides DDS: the door, and the port for its heartbeats.
OWN = [f'tcp:0.0.0.0:{network.PORT}', f'udp:0.0.0.0:{network.heartbeats(GUEST)}']
#: Gives a guest an account, whose program leaves files; ends it, and gives another one, without
#: processes. Prints the ids of both, how much System V keeps of the first, and the packet filter,
#: and the seconds in which the second one ended.
ACCOUNTS = """
import os, pathlib, pwd, socket, subprocess, sys, types
guests = types.ModuleType('guests')
exec(compile(sys.stdin.read(), 'guests', 'exec'), guests.__dict__)
LEAVE = '''
import os, shutil, sys
for folder in sys.argv[1:]:
    os.mkdir(folder + '/of a guest')
    shutil.copy('/usr/bin/id', folder + '/of a guest')
    os.chmod(folder + '/of a guest/id', 0o6755)
for _ in range(1100):
    os.mkdir('d')
    os.chdir('d')
'''
FOLDERS = ['/run/lock', '/tmp', '/dev/shm', '/srv/any body']
os.mkdir(FOLDERS[-1])
os.chmod(FOLDERS[-1], 0o1777)
door = types.SimpleNamespace(agent='', request={'machine': 'm', 'shell': 'pass'})
ids = []
for _ in range(2):
    here, there = socket.socketpair()
    guests.Door.begin(door, there, 'fogabc123m0g224').wait()
    found = pwd.getpwnam('fogabc123m0g224')
    ids.append(found.pw_uid)
    if len(ids) == 1:
        for words in ([sys.executable, '-c', LEAVE, *FOLDERS],
                      ['ipcmk', '--shmem', '4096', '--queue', '--semaphore', '1']):
            subprocess.run(words, user=found.pw_uid, group=found.pw_gid, extra_groups=(),
                           stdout=subprocess.DEVNULL, check=True, cwd=found.pw_dir)
    guests.evict('fogabc123m0g224')
assert not guests.HOMES.exists()
tables = subprocess.run(['nft', 'list', 'tables'], capture_output=True, text=True, check=True)
print(*ids, sum(path.read_text().count(str(ids[0])) for path in
                pathlib.Path('/proc/sysvipc').iterdir()), tables.stdout.count('fogabc123m0g224'))
"""
#: Seconds in which WireGuard makes a second attempt at a handshake.
ATTEMPTS = 6.0


def listen(vpn: Lab, host: str) -> Child:
    child = vpn.start(host, [sys.executable, '-c', LISTENER, *PORTS, *OWN, DDS])
    child.wait('ready')
    return child


def send(vpn: Lab, *to: str) -> None:
    vpn.start('guest', [sys.executable, '-c', SENDER, *to]).process.wait(60)


def silent(guest: Guest) -> bool:
    """Tell whether the machine answers nothing to a guest that tries to connect."""
    before = guest.received()
    guest.up(answered=False)
    assert not guest.lab.ping('guest', MACHINE, timeout=ATTEMPTS)
    return guest.received() == before


def looked(guest: Guest) -> bool:
    """Run the machine's health check, as its agent does; tell whether a guest is left."""
    vpn = guest.lab
    vpn.run('machine', vpn.vpn.health_check(vpn.interfaces['machine']))
    return guest.key in vpn.shell('machine', 'wg show all peers')


def test_guest_reaches_dds_ping_and_its_door_alone(vpn: Lab, guest: Guest) -> None:
    # a machine that forwards, and a hijacked guest that sends all it can through the VPN
    vpn.shell('machine', 'echo 1 >/proc/sys/net/ipv4/ip_forward')
    guest.admit()
    guest.up()
    vpn.shell('guest', f'wg set {guest.interface.name} peer {guest.machine_key} '
              'allowed-ips 198.18.7.0/24,203.0.113.2/32')
    vpn.ip('-n', vpn.spaces['guest'], 'route', 'add', '203.0.113.2', 'dev', guest.interface.name)
    machine, robot = listen(vpn, 'machine'), listen(vpn, 'robot')
    send(vpn, *(word.replace('0.0.0.0', host) for host in (MACHINE, ROBOT, '203.0.113.2')
                for word in (*PORTS, *OWN, DDS)))
    send(vpn, f'udp:{MACHINE}:7410')
    machine.wait('said', count=4)
    assert sorted(line['at'] for line in machine.lines('said')) == sorted([*OWN, DDS, DDS])
    assert robot.lines('said') == []
    assert not vpn.ping('guest', ROBOT, timeout=1.0) and vpn.ping('guest', MACHINE)


def test_only_a_guest_that_is_invited_gets_an_answer(guest: Guest) -> None:
    """An invitation of another computer, an expired and a withdrawn one get none."""
    vpn = guest.lab
    guest.admit()
    guest.new_key()
    assert silent(guest)
    guest.down()
    guest.ask('remove', keys=None)
    guest.admit(seconds=1.0)
    wait_until(lambda: not looked(guest), timeout=60.0, what='the end of the invitation')
    assert '.due' not in vpn.shell('machine', 'ls /run'), 'nothing is looked at any more'
    assert silent(guest)
    guest.down()
    # one that is connected stays beyond its invitation, and goes when it is absent
    guest.admit(seconds=2.0, patience=10.0)
    guest.up()
    wait_until(lambda: guest.ask('look')[0]['left'] < 0, timeout=60.0, what='the expiry')
    assert looked(guest) and vpn.ping('guest', MACHINE)
    guest.down()
    wait_until(lambda: not looked(guest), timeout=60.0, what='the guest to be removed')
    assert silent(guest)
    guest.down()
    guest.admit()
    guest.up()
    assert guest.ask('remove', keys=[guest.key]) == []
    assert silent(guest)  # the invitation is used again, with the same key


def test_changed_peers_and_repairs_keep_the_guest(vpn: Lab, guest: Guest) -> None:
    guest.admit()
    guest.up()
    interface, peers = vpn.interfaces['machine'], vpn.peers()['machine']
    for commands in (vpn.vpn.peers(interface, peers), vpn.vpn.repair(interface, peers)):
        vpn.do('machine', commands)
        assert vpn.ping('guest', MACHINE, timeout=60.0)
    vpn.shell('machine', 'nft flush ruleset')
    vpn.do('machine', vpn.vpn.repair(interface, peers))
    assert f'table inet {interface.name}g' in vpn.shell('machine', 'nft list tables')
    # not without its filter
    vpn.shell('machine', f'rm /run/{interface.name}.more.rules')
    vpn.do('machine', vpn.vpn.repair(interface, peers))
    assert guest.key not in vpn.shell('machine', 'wg show all peers')
    vpn.do('machine', vpn.vpn.down(interface))
    assert vpn.shell('machine', f'ls /run/{interface.name}.* || :') == ''
    assert interface.name not in vpn.shell('machine', 'nft list tables')


def test_next_guest_owns_no_file_of_a_former_one(cloud: Cloud) -> None:
    """Both have an account on a machine, at the same address of the VPN."""
    with cloud.machine() as (_, shell):
        said = shell.run(Command(
            ('python3', '-c', ACCOUNTS), sudo=True, input=Path(guests.__file__).read_bytes()),
            timeout=60.0).stdout
        look = Command(('find', '/', '/dev/shm', '-xdev', '-name', '*of a guest*'), sudo=True)
        wait_until(lambda: not shell.run(look, timeout=60.0, check=False).stdout, timeout=60.0,
                   what='all files of the guest to be gone')
    first, second, kept, filters = map(int, said.split())
    assert kept == filters == 0
    assert first != second and first in guests.IDS and second in guests.IDS
