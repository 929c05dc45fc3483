# SPDX-License-Identifier: Apache-2.0
"""Hosts outside the VPN that send DDS to machines, and machines that lie about their addresses."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from pathlib import Path
import sys
import time

import pytest

from rigs.vpn_lab import Child, Lab, opened

RTPS = str(Path(__file__).parents[1] / 'rigs/rtps.py')
ROBOT, MACHINE = '198.18.7.1', '198.18.7.2'
#: The machine's address outside of the VPN, where a stranger is its neighbour.
OUTSIDE = '203.0.113.2'
#: The robot's address on its LAN.
LAN = '192.168.77.1'
#: Prints what UDP packets say that arrive at its arguments, host:port. Joins all groups of DDS on
#: each interface, which lets the kernel pass their packets to the nodes of other accounts, too.
LISTENER = '''
import json, selectors, socket, struct, sys
chosen = selectors.DefaultSelector()
for word in sys.argv[1:]:
    host, _, port = word.partition(':')
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.bind((host, int(port)))
    for _, name in socket.if_nameindex():
        for group in ('239.255.0.1', '239.18.7.1', '239.18.7.2') if name != 'lo' else ():
            one.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, struct.pack(
                '4s4si', socket.inet_aton(group), bytes(4), socket.if_nametoindex(name)))
    chosen.register(one, selectors.EVENT_READ, word)
print(json.dumps({'ready': True}), flush=True)
while True:
    for key, _ in chosen.select():
        print(json.dumps({'said': key.fileobj.recv(2000)[4:].decode(errors='replace'),
                          'at': key.data}), flush=True)
'''
#: Sends a DDS message with a text to each argument, host:port.
SENDER = '''
import socket, sys
one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for word in sys.argv[2:]:
    host, _, port = word.partition(':')
    one.sendto(b'RTPS' + sys.argv[1].encode(), (host, int(port)))
'''


@dataclasses.dataclass
class Launch:
    """A robot with a LAN and a machine, with a node on each."""

    vpn: Lab
    robot: Child
    machine: Child


@pytest.fixture(scope='module', params=['cyclonedds 0.10', 'fastdds'])
def running(
    request: pytest.FixtureRequest, tun: None, tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Launch]:
    with opened(Lab(tmp_path_factory.mktemp('launch'), request.param)) as vpn:
        vpn.lan()
        vpn.connect()
        route(vpn, 'net', MACHINE, 'via', OUTSIDE)
        route(vpn, 'net', '239.0.0.0/8', 'dev', 'e1')
        yield Launch(vpn, vpn.node('robot', 'to:/ok'),
                     vpn.node('machine', 'from:/ok', 'from:/cmd_vel', 'to:/up'))


@pytest.fixture
def launch(running: Launch) -> Iterator[Launch]:
    """Return a launch; the strangers of a test end with it."""
    own = len(running.vpn.children)
    yield running
    for child in running.vpn.children[own:]:
        child.stop()


def listener(vpn: Lab, host: str, *at: str, group: str = '') -> Child:
    child = vpn.start(host, [sys.executable, '-c', LISTENER, *at], group=group)
    child.wait('ready')
    return child


def send(vpn: Lab, host: str, text: str, *to: str) -> None:
    vpn.start(host, [sys.executable, '-c', SENDER, text, *to]).process.wait(60)


def route(vpn: Lab, host: str, *words: str) -> None:
    vpn.ip('-n', vpn.spaces[host], 'route', 'add', *words)


def announce(vpn: Lab, host: str, places: list[str], *claimed: str) -> None:
    """Announce participants that claim some addresses, until the test ends."""
    vpn.start(host, [sys.executable, RTPS, 'announce', ','.join(places), *claimed])


def test_machine_hears_dds_from_its_launch_only(vpn: Lab) -> None:
    machine = listener(vpn, 'machine', '0.0.0.0:7400')
    # Linux takes packets for any of its addresses on any interface
    route(vpn, 'net', MACHINE, 'via', OUTSIDE)
    route(vpn, 'net', '239.255.0.1', 'dev', 'e1')
    send(vpn, 'net', 'stranger', f'{OUTSIDE}:7400', f'{MACHINE}:7400', '239.255.0.1:7400')
    send(vpn, 'machine', 'itself', '127.0.0.1:7400')
    send(vpn, 'robot', 'robot', f'{MACHINE}:7400')
    machine.wait('said', 'robot')
    assert [line['said'] for line in machine.lines('said')] == ['itself', 'robot']


def test_host_of_others_filters_the_launch_only(lab: Lab) -> None:
    lab.launch('machine')
    lab.connect()
    ours = listener(lab, 'machine', '0.0.0.0:7410', group=lab.interfaces['machine'].name)
    theirs = listener(lab, 'machine', '0.0.0.0:7412')
    send(lab, 'net', 'stranger', f'{OUTSIDE}:7410', f'{OUTSIDE}:7412')
    send(lab, 'robot', 'robot', f'{MACHINE}:7410')
    theirs.wait('said', 'stranger')
    ours.wait('said', 'robot')
    assert [line['said'] for line in ours.lines('said')] == ['robot']


def test_stranger_cannot_publish_on_a_machine(launch: Launch) -> None:
    """Cyclone 0.10 (ROS 2 Jazzy) would take these messages, 11 would not."""
    stranger = launch.vpn.start('net', [
        sys.executable, RTPS, 'inject', f'{OUTSIDE}:7410,{OUTSIDE}:7411', '/cmd_vel', '1 0 bad'])
    stranger.wait('round', 5)
    launch.machine.wait('topic', '/ok', count=5, after=time.monotonic())
    assert launch.machine.lines('topic', '/cmd_vel') == []


def test_robot_sends_no_dds_where_a_machine_points(launch: Launch) -> None:
    vpn = launch.vpn
    traps = ['192.168.77.2:7410', '192.168.77.2:5000', '127.0.0.1:14550', '192.168.77.1:9000']
    lan = listener(vpn, 'lan', *traps[:2])
    local = listener(vpn, 'robot', *traps[2:])
    machine = listener(vpn, 'machine', f'{MACHINE}:6000')
    announce(vpn, 'machine', [f'{ROBOT}:7410'], *traps, f'{MACHINE}:6000')
    # the robot answers all participants alike, and may answer in the VPN
    machine.wait('said', count=20, timeout=60.0)
    assert lan.lines('said') == [] and local.lines('said') == []
    assert launch.robot.process.poll() is None


def test_machine_answers_no_participant_outside_the_vpn(launch: Launch) -> None:
    """Participants claim addresses in the VPN, to which a node that takes them sends."""
    vpn = launch.vpn
    listener(vpn, 'machine', f'{OUTSIDE}:9000')
    robot = listener(vpn, 'robot', f'{ROBOT}:7498', f'{ROBOT}:7499')
    announce(vpn, 'net', [f'{OUTSIDE}:7410', f'{MACHINE}:7410', '239.255.0.1:7400',
                          '239.18.7.2:7402'], f'{ROBOT}:7498')
    announce(vpn, 'robot', [f'{MACHINE}:7410'], f'{ROBOT}:7499')
    robot.wait('at', f'{ROBOT}:7499', count=20, timeout=60.0)
    assert robot.lines('at', f'{ROBOT}:7498') == []


@pytest.mark.parametrize('middleware', ['fastdds'])
def test_robot_limited_to_itself_answers_no_participant_of_lan(vpn: Lab) -> None:
    vpn.user = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    vpn.lan()
    vpn.node('robot', 'to:/up')
    listener(vpn, 'robot', f'{LAN}:9000')
    route(vpn, 'lan', ROBOT, 'via', LAN)
    route(vpn, 'lan', '239.0.0.0/8', 'dev', 'lan0')
    machine = listener(vpn, 'machine', f'{MACHINE}:6000', f'{MACHINE}:6001')
    announce(vpn, 'lan', [f'{LAN}:7410', f'{ROBOT}:7410', '239.255.0.1:7400', '239.18.7.1:7402'],
             f'{MACHINE}:6000')
    announce(vpn, 'machine', [f'{ROBOT}:7410'], f'{MACHINE}:6001')
    machine.wait('at', f'{MACHINE}:6001', count=20, timeout=60.0)
    assert machine.lines('at', f'{MACHINE}:6000') == []
