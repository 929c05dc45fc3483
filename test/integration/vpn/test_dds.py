# SPDX-License-Identifier: Apache-2.0
"""
DDS on a robot with a VPN that is cut, killed, absent or moved: real participants and WireGuard.

Those of Fast DDS are nodes of ROS 2. Those of Cyclone DDS do without ROS 2, so that its settings
are judged where ROS 2 has only its default: in ROS 2 Jazzy's version and in the newest.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import time
from typing import TYPE_CHECKING

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.waiting import wait_until
from rigs.vpn_lab import Lab, opened, ROBOT

if TYPE_CHECKING:
    from rigs.vpn_lab import Child

#: Seconds after the link's return within which messages flow again: usually 0.2. WireGuard waits
#: 5 s before it repeats a handshake.
PROMPT = 4.0


MIDDLEWARES = ['cyclonedds 0.10', 'fastdds']


@pytest.fixture(params=MIDDLEWARES)
def middleware(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@dataclasses.dataclass
class Talk:
    """A robot's node, another beside it, and a machine's, which talk by the VPN."""

    vpn: Lab
    robot: Child
    beside: Child
    machine: Child
    #: Hears a node that, like itself, is older than the VPN.
    early: Child
    #: When the VPN came up: begin and end.
    connecting: tuple[float, float]

    def wait(self, since: float = 0.0) -> None:
        """Wait until all are heard."""
        for child, topic in ((self.machine, '/up'), (self.robot, '/down'),
                             (self.beside, '/local')):
            child.wait('topic', topic, count=3, after=since, timeout=60.0)


@pytest.fixture(scope='module', params=MIDDLEWARES)
def running(
    request: pytest.FixtureRequest, tun: None, tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Talk]:
    with opened(Lab(tmp_path_factory.mktemp('talk'), request.param)) as lab:
        lab.node('robot', 'to:/early')
        early = lab.node('robot', 'from:/early', 'from:/local')
        early.wait('topic', '/early')
        begin = time.monotonic()
        lab.connect()
        connecting = begin, time.monotonic()
        yield Talk(lab, machine=lab.node('machine', 'from:/up', 'to:/down'),
                   robot=lab.node('robot', 'to:/up', 'from:/down', 'to:/local'),
                   beside=lab.node('robot', 'from:/local'),
                   early=early, connecting=connecting)


@pytest.fixture
def talk(running: Talk) -> Talk:
    """Return nodes that talk; what a test does to their link it takes back."""
    running.wait(time.monotonic())
    return running


def heard(child: Child, topic: str, begin: float, end: float) -> float:
    """Return which part of the messages that were sent in a time arrived in it."""
    # none comes before an earlier one
    child.wait('topic', topic, after=end, timeout=60.0)
    lines = [line for line in child.lines('topic', topic, after=begin)
             if line['arrival'] - line['latency'] < end]
    return sum(line['arrival'] < end for line in lines) / len(lines)


def heals(machine: Child, robot: Child, since: float) -> None:
    """Check that messages sent after the link's return arrive, both ways."""
    for child, topic in ((machine, '/up'), (robot, '/down')):
        line = child.wait('topic', topic, after=since, timeout=60.0)[0]
        assert line['arrival'] - since < PROMPT, f'{topic} took {line["arrival"] - since:.1f} s'


def pause(seconds: float) -> tuple[float, float]:
    """Let messages come for a while that is itself what the test looks at."""
    begin = time.monotonic()
    time.sleep(seconds)
    return begin, time.monotonic()


@pytest.mark.parametrize('middleware', ['fastdds'])
def test_messages_cross_with_an_overlapping_machine_network(lab: Lab) -> None:
    # the machine's own network is the very one that the launch has chosen
    lab.link('machine', 'own0', '198.18.7.200/24', 'lan', 'own0', '198.18.7.201/24')
    lab.interfaces['machine'] = dataclasses.replace(lab.interfaces['machine'], host_routes=True)
    lab.connect()
    machine = lab.node('machine', 'from:/up', 'to:/down')
    robot = lab.node('robot', 'to:/up', 'from:/down')
    machine.wait('topic', '/up', count=3)
    robot.wait('topic', '/down', count=3)
    assert lab.ping('machine', '198.18.7.201') and lab.ping('lan', '198.18.7.200')
    # and again, as a repair has it
    lab.repair('machine')
    assert lab.ping('machine', ROBOT) and lab.ping('machine', '198.18.7.201')


@pytest.mark.parametrize('middleware', [*MIDDLEWARES, 'cyclonedds'])
def test_machines_lan_and_terminals_talk_with_the_robot(vpn: Lab) -> None:
    vpn.lan()
    vpn.second()
    # a LAN other than the robot's own network: what a node without a configuration takes
    vpn.ip('-n', vpn.spaces['robot'], 'link', 'set', 'e0', 'multicast', 'off')
    lan = vpn.node('lan', 'from:/to_lan', 'to:/from_lan', stock=True)
    robot = vpn.node('robot', 'to:/to_lan', 'from:/from_lan', 'to:/up', 'from:/down',
                     'from:/second')
    terminal = vpn.node('robot', 'from:/to_lan', stock=True)
    machine = vpn.node('machine', 'from:/up', 'to:/down', 'from:/second')
    second = vpn.node('second', 'from:/up', 'to:/second', 'from:/down')
    for child, topic in ((lan, '/to_lan'), (robot, '/from_lan'), (terminal, '/to_lan'),
                         (machine, '/up'), (robot, '/down'), (second, '/up'), (robot, '/second'),
                         (machine, '/second'), (second, '/down')):
        child.wait('topic', topic, count=5, timeout=60.0)
    # a new address of the LAN's is the end of that, as ever, but of nothing else
    vpn.ip('-n', vpn.spaces['robot'], 'address', 'delete', '192.168.77.1/24', 'dev', 'lan0')
    heals(machine, robot, time.monotonic())


def test_robot_nodes_talk_while_the_vpn_comes_up(talk: Talk) -> None:
    begin, end = talk.connecting
    assert heard(talk.early, '/early', begin, end) > 0.5
    # it doesn't have the VPN, nodes of after do, and all have each other
    talk.early.wait('topic', '/local', count=5)


def test_a_cut_is_survived(talk: Talk) -> None:
    talk.vpn.bad(cut=True)
    begin, end = pause(8.0)
    talk.vpn.bad(cut=False)
    heals(talk.machine, talk.robot, time.monotonic())
    assert heard(talk.beside, '/local', begin, end) > 0.9
    assert not [line for line in talk.machine.lines('topic', '/up', after=begin)
                if line['arrival'] < end]


def test_lost_packets_are_sent_again(talk: Talk) -> None:
    talk.vpn.bad(loss=0.05)
    begin, end = pause(5.0)
    talk.vpn.bad(loss=0.0)
    last = talk.machine.wait('topic', '/up', after=end)[0]['number']
    numbers = [line['number'] for line in talk.machine.lines('topic', '/up', after=begin)
               if line['number'] < last]
    assert numbers == list(range(numbers[0], last))


@pytest.mark.parametrize('host', ['robot', 'machine'])
def test_nodes_survive_a_killed_wireguard_go(talk: Talk, host: str) -> None:
    vpn = talk.vpn
    if not vpn.wireguard_go(host):
        pytest.skip('this kernel has WireGuard itself')
    assert vpn.alive(host)
    process.run(Command(('kill', '-9', str(vpn.wireguard_go(host))), sudo=True), timeout=60.0)
    begin, end = pause(1.0)
    since = time.monotonic()
    vpn.repair(host)
    heals(talk.machine, talk.robot, since)
    assert heard(talk.beside, '/local', begin, end) > 0.5


def test_a_moving_robot_stays_in_touch(talk: Talk) -> None:
    vpn, space = talk.vpn, talk.vpn.spaces['robot']
    vpn.ip('-n', space, 'address', 'delete', '198.51.100.2/24', 'dev', 'e0')
    begin, end = pause(1.0)
    vpn.ip('-n', space, 'address', 'add', '198.51.100.9/24', 'dev', 'e0')
    since = time.monotonic()
    assert not vpn.alive('robot')
    vpn.repair('robot')
    heals(talk.machine, talk.robot, since)
    assert heard(talk.beside, '/local', begin, end) > 0.5
    vpn.bad(rebind=True)
    heals(talk.machine, talk.robot, time.monotonic())


def test_an_interface_that_is_taken_away_harms_no_node(talk: Talk) -> None:
    vpn = talk.vpn
    vpn.ip('-n', vpn.spaces['robot'], 'link', 'delete', vpn.interfaces['robot'].name)
    begin, end = pause(2.0)
    assert heard(talk.beside, '/local', begin + 0.5, end) > 0.5
    assert not vpn.alive('robot')
    since = time.monotonic()
    vpn.repair('robot')
    heals(talk.machine, talk.robot, since)


def test_unread_topics_send_only_announcements_across(talk: Talk) -> None:
    vpn = talk.vpn
    # bytes a second, with the messages of the nodes that talk
    idle = 40_000.0
    camera = vpn.node('robot', 'to:/camera', '--size', '50000')
    beside = vpn.node('robot', 'from:/camera')
    beside.wait('topic', '/camera', count=3)

    def rate() -> float:
        before = vpn.carried('robot')
        begin, end = pause(2.0)
        return (vpn.carried('robot') - before) / (end - begin)

    wait_until(lambda: rate() < idle, timeout=60.0, what='announcements alone')
    reader = vpn.node('machine', 'from:/camera')
    reader.wait('topic', '/camera', count=3)
    assert rate() > 3 * idle
    reader.stop()
    # what is under way when the reader leaves still counts
    wait_until(lambda: rate() < idle, timeout=60.0, what='announcements alone')
    assert camera.process.poll() is None
    camera.stop()
    beside.stop()
