# SPDX-License-Identifier: Apache-2.0
"""Relays of shared topics as processes, each in a ROS domain that stands for a robot's launch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
from pathlib import Path
import socket
import threading
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32, String

from fogros2.waiting import wait_until
from fogros2_share.node import machine_of, NAME, OWN, Relay
from fogros2_share.wire import encode, Form
from rigs.sharing import BEST_EFFORT, LATCHED, repeated, Robot, robot

__all__ = ['robot']


def test_listed_topics_reach_the_other_robots_only(robot: Callable[[str], Robot]) -> None:
    one, two, three = robots = [robot(name) for name in ('one', 'two', 'three')]
    one.start('/chat', '/map')
    two.start('/chat', '/map', '/mine')
    three.start('/map')
    heard, other = two.heard(String, '/chat'), three.heard(String, '/chat')
    unlisted, mine = one.heard(String, '/mine'), two.heard(String, '/secret')
    own = one.heard(String, '/chat')
    secret, listed_there = one.publisher(String, '/secret'), two.publisher(String, '/mine')

    def make(number: int) -> String:
        secret.publish(String(data='secret'))
        listed_there.publish(String(data='mine'))
        return String(data=f'message {number}')

    repeated(one.publisher(String, '/chat'), make, heard, 20)
    texts = [message.data for message in heard]
    assert texts == [f'message {int(texts[0].split()[1]) + n}' for n in range(len(texts))]
    assert other == unlisted == mine == []
    # and nothing comes back to where it was published
    sent = [message.data for message in own]
    assert len(sent) == len(set(sent))
    all_publish_the_same_topic(robots)
    for each in robots:
        assert each.stop() == 0, ''.join(each.lines)


def all_publish_the_same_topic(robots: list[Robot]) -> None:
    """Each hears the others' maps beside its own, once, and no relay sends one back."""
    publishers, heard = [], []
    for number, each in enumerate(robots):
        publishers.append(each.publisher(OccupancyGrid, '/map', LATCHED))
        publishers[-1].publish(OccupancyGrid(data=[number]))
        heard.append(each.heard(OccupancyGrid, '/map', QoSProfile(
            depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)))
    wait_until(lambda: all(len(maps) >= 3 for maps in heard), timeout=60, what='all maps')
    # a message that is sent back would be under way by then
    publishers[0].publish(OccupancyGrid(data=[9]))
    wait_until(lambda: all(9 in [one.data[0] for one in maps] for maps in heard), timeout=60,
               what='a new map')
    for maps in heard:
        assert sorted(message.data[0] for message in maps) == [0, 1, 2, 9]


def test_robot_that_comes_later_gets_the_map(robot: Callable[[str], Robot]) -> None:
    one, two = robot('one'), robot('two')
    maps = one.publisher(OccupancyGrid, '/map', LATCHED)
    one.start('/map')
    for number in range(3):
        maps.publish(OccupancyGrid(data=[number] * 1000))
    two.start('/map')
    # the map travels, then stays with the relay of the second robot
    first = two.heard(OccupancyGrid, '/map', LATCHED)
    wait_until(lambda: bool(first), timeout=60, what='the map')
    later = two.heard(OccupancyGrid, '/map', LATCHED)
    wait_until(lambda: bool(later), timeout=60, what='the map, for another node')
    assert [message.data[0] for message in (*first, *later)] == [2, 2]
    # as if its publisher were here, the map ends with the first robot
    one.stop()
    wait_until(lambda: not two.node.count_publishers('/map'), timeout=60, what='its end')
    assert two.relay is not None and two.relay.poll() is None, two.lines


def test_latched_value_of_another_robot_may_be_repeated(
        robot: Callable[[str], Robot]) -> None:
    """Otherwise robots would disagree for ever, such as on an emergency stop."""
    one, two = robot('one'), robot('two')
    for each in (one, two):
        each.start('/stop')
    heard, seen = (each.heard(Int32, '/stop', LATCHED) for each in (one, two))
    one.publisher(Int32, '/stop', LATCHED).publish(Int32(data=0))
    wait_until(lambda: [message.data for message in seen] == [0], timeout=60, what='the value')
    publisher = two.publisher(Int32, '/stop', LATCHED)
    for count, value in enumerate((1, 0, 1, 0)):
        publisher.publish(Int32(data=value))
        wait_until(lambda count=count: len(heard) == count + 2, timeout=60, what='the next value')
    assert [message.data for message in heard] == [0, 1, 0, 1, 0]
    assert [message.data for message in seen] == [0, 1, 0, 1, 0]


def test_qos_and_type_of_publishers_are_kept(robot: Callable[[str], Robot]) -> None:
    one, two = robot('one'), robot('two')
    topics = '/fast', '/count', '/late'
    one.start(*topics)
    two.start(*topics)
    wrong, count = two.heard(Int32, '/count'), one.publisher(String, '/count')
    heard = two.heard(String, '/fast', BEST_EFFORT)
    reliable = two.heard(String, '/fast')
    publisher = one.publisher(String, '/fast', BEST_EFFORT)
    repeated(publisher, lambda number: String(data='fast'), heard)
    assert reliable == []
    profiles = [info.qos_profile for info in two.node.get_publishers_info_by_topic('/fast')]
    assert [each.reliability for each in profiles] == [ReliabilityPolicy.BEST_EFFORT]
    # a publisher with another QoS changes it for the other robots too
    one.node.destroy_publisher(publisher)
    publisher = one.publisher(String, '/fast')
    repeated(publisher, lambda number: String(data='sure'), reliable)

    def look() -> bool:
        count.publish(String(data='three'))
        return any('so it is not shared' in line for line in two.lines)

    wait_until(look, timeout=60, what='the warning of another type')
    assert wrong == []
    # a node here uses another type later; with Fast DDS, a process has one type of a topic
    late: list[object] = []
    count = one.publisher(String, '/late')

    def look_again() -> bool:
        count.publish(String(data='three'))
        if not late and two.node.count_publishers('/late'):
            late.append(two.publisher(Int32, '/late'))
        return any('/late is ' in line for line in two.lines)

    wait_until(look_again, timeout=60, what='the warning')
    # a relay that was killed starts again
    assert one.relay is not None
    one.relay.kill()
    one.relay.wait(60)
    one.start(*topics)
    repeated(publisher, lambda number: String(data='after'), reliable, len(reliable) + 5)
    assert reliable[-1].data == 'after'


@contextlib.contextmanager
def stranger(folder: Path, *data: bytes) -> Iterator[list[bool]]:
    """Stand for a hijacked machine, whose relay sends ``data``; yield its connections' fates."""
    (folder / OWN).mkdir(parents=True)
    fates: list[bool] = []
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(folder / OWN / NAME))
        server.listen()

        def answer(connection: socket.socket) -> None:
            with connection:
                try:
                    connection.recv(256)  # which machine it is
                    for part in data:
                        connection.sendall(part)
                    fates.append(connection.recv(1) == b'')
                except ConnectionError:  # it has left before it read everything
                    fates.append(True)

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    threading.Thread(
                        target=answer, args=(server.accept()[0],), daemon=True).start()

        threading.Thread(target=serve, daemon=True).start()
        yield fates
        server.shutdown(socket.SHUT_RDWR)


def test_hijacked_relays_reach_nothing_and_others_go_on(robot: Callable[[str], Robot]) -> None:
    one, two = robot('one'), robot('two')
    (one.fleet / 'file' / OWN).mkdir(parents=True)
    (one.fleet / 'file' / OWN / NAME).write_text('no socket')
    large = encode('/chat', Form('std_msgs/msg/String', True, 0), 999_999_999)
    forged = [encode(topic, Form(kind, True, 1), 4) + b'\0\1\0\0' for topic, kind in (
        ('/secret', 'std_msgs/msg/String'), ('/chat', 'antigravity/msg/String'),
        ('/chat', 'json/msg/String'), ('/chat', 'std_msgs/msg/NoSuch'))]
    # one changes its QoS at once; the message after the change is not dropped
    data = b'\0\1\0\0\2\0\0\0b\0'
    quick = [encode('/quick', Form('std_msgs/msg/String', True, kept), len(data)) + data
             for kept in (0, 1)]
    with stranger(one.fleet / 'evil', b'[' * 3000) as fates, \
            stranger(one.fleet / 'large', large) as others, \
            stranger(one.fleet / 'forger', *forged), stranger(one.fleet / 'quick', *quick):
        one.start('/chat', '/quick')
        two.start('/chat')
        wait_until(lambda: True in fates and True in others, timeout=60,
                   what='the relays to leave')
        wait_until(lambda: any("'json/msg/String'" in line for line in one.lines), timeout=60,
                   what='the warning')
        for sender, hearer in ((one, two), (two, one)):
            repeated(sender.publisher(String, '/chat'), lambda number: String(data='go on'),
                     hearer.heard(String, '/chat'))
        latched = one.heard(String, '/quick', LATCHED)
        wait_until(lambda: bool(latched), timeout=60, what='the message')
        names = [name for name, _ in one.node.get_topic_names_and_types()]
    assert '/secret' not in names
    assert any('shares no messages' in line for line in one.lines)


def test_relay_without_its_folder_says_why(robot: Callable[[str], Robot]) -> None:
    one = robot('one')
    (one.folder / OWN).rmdir()
    one.folder.rmdir()
    one.start('/chat')
    assert one.relay is not None and one.relay.wait(60) == 1
    wait_until(lambda: any('made without share=' in line for line in one.lines), timeout=60,
               what='the reason')


def test_relay_finds_its_folder_while_others_begin(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    """Such as one that a power cut left without ``own``, or that this user may not read yet."""
    own = tmp_path / 'mine' / OWN
    own.mkdir(parents=True)
    monkeypatch.setattr(Path, 'iterdir', lambda _: iter((tmp_path / 'begun', own.parent)))
    assert machine_of(own, tmp_path) == 'mine'


def test_relay_closes_before_a_thread_has_started() -> None:
    with socket.socket() as server:
        Relay.close(SimpleNamespace(  # type: ignore[arg-type]
            _lock=threading.Lock(), _server=server, _links=(), _readers={},
            _robots={Path('other'): threading.Thread()}))
