# SPDX-License-Identifier: Apache-2.0
"""Relays of shared topics as processes, each in a ROS domain that stands for a robot's launch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import json
import os
from pathlib import Path
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from typing import Any, Optional

import pytest

pytest.importorskip('rclpy', reason='neither ROS 2 nor the embedded default is installed')
from nav_msgs.msg import OccupancyGrid
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32, String

from fogros2.waiting import wait_until
from fogros2_share.node import NAME
from fogros2_share.wire import encode, Form
from rigs.domains import taken

ROOT = Path(__file__).parents[2]
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
pytestmark = pytest.mark.timeout(120)


class Robot:
    """A robot: a domain with a node of the test, and the relay of its machine."""

    def __init__(self, fleet: Path, name: str, domain: str) -> None:
        self.folder, self.fleet, self.domain = fleet / name, fleet, domain
        self.folder.mkdir()
        self.lines: list[str] = []
        self.relay: Optional[subprocess.Popen[str]] = None
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(domain))
        self.node = Node('planner', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()

    def start(self, *topics: str) -> None:
        """Start its relay."""
        self.relay = subprocess.Popen(
            [sys.executable, str(ROOT / 'fogros2_share/scripts/share'), json.dumps({
                'topics': topics, 'folders': [str(self.folder), str(self.fleet)]})],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            env={**os.environ, 'ROS_DOMAIN_ID': self.domain, 'PYTHONPATH': os.pathsep.join(
                filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')]))})
        threading.Thread(target=lambda: self.lines.extend(self.relay.stdout), daemon=True).start()

    def stop(self) -> int:
        """Interrupt its relay."""
        assert self.relay is not None
        self.relay.send_signal(signal.SIGINT)
        return self.relay.wait(15)

    def heard(self, kind: Any, topic: str, qos: Any = 10) -> list[Any]:
        """Return the messages that its node hears, a list that grows."""
        found: list[Any] = []
        self.node.create_subscription(kind, topic, found.append, qos)
        return found

    def publisher(self, kind: Any, topic: str, qos: Any = 10) -> Any:
        return self.node.create_publisher(kind, topic, qos)

    def close(self) -> None:
        if self.relay is not None and self.relay.poll() is None:
            self.relay.kill()
            self.relay.wait()
        self.executor.shutdown()
        self.thread.join(10)
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Robot]]:
    """Return what makes a robot; their DDS stays on the loopback, in domains of their own."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    # a path of a socket is short
    fleet = Path(tempfile.mkdtemp(prefix='fogt'))
    with contextlib.ExitStack() as undo:
        undo.callback(shutil.rmtree, fleet)

        def make(name: str) -> Robot:
            made = Robot(fleet, name, undo.enter_context(taken()))
            undo.callback(made.close)
            return made

        yield make


def repeated(publisher: Any, make: Callable[[int], Any], heard: list[Any], count: int = 5) -> None:
    """Publish until so many messages were heard."""
    numbers = iter(range(10_000))

    def look() -> bool:
        publisher.publish(make(next(numbers)))
        return len(heard) >= count

    wait_until(look, timeout=40, longest=0.05, what='the shared messages')


def test_listed_topics_reach_the_other_robots_only(robot: Callable[[str], Robot]) -> None:
    one, two, three = robot('one'), robot('two'), robot('three')
    one.start('/chat')
    two.start('/chat', '/mine')
    three.start('/else')
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
    for each in (one, two, three):
        assert each.stop() == 0, each.lines


def test_robot_that_comes_later_gets_the_map(robot: Callable[[str], Robot]) -> None:
    one, two = robot('one'), robot('two')
    maps = one.publisher(OccupancyGrid, '/map', LATCHED)
    one.start('/map')
    for number in range(3):
        maps.publish(OccupancyGrid(data=[number] * 1000))
    two.start('/map')
    # the map travels, then stays with the relay of the second robot
    first = two.heard(OccupancyGrid, '/map', LATCHED)
    wait_until(lambda: bool(first), timeout=40, what='the map')
    later = two.heard(OccupancyGrid, '/map', LATCHED)
    wait_until(lambda: bool(later), timeout=20, what='the map, for another node')
    assert [message.data[0] for message in (*first, *later)] == [2, 2]
    # as if its publisher were here, the map ends with the first robot
    one.stop()
    wait_until(lambda: not two.node.count_publishers('/map'), timeout=20, what='its end')
    assert two.relay is not None and two.relay.poll() is None, two.lines


def test_both_robots_publish_the_same_topic(robot: Callable[[str], Robot]) -> None:
    """Each hears the other's map beside its own, once, and no relay sends one back."""
    robots = [robot('one'), robot('two'), robot('three')]
    publishers = [each.publisher(OccupancyGrid, '/map', LATCHED) for each in robots]
    heard = []
    for number, each in enumerate(robots):
        publishers[number].publish(OccupancyGrid(data=[number]))
        heard.append(each.heard(OccupancyGrid, '/map', QoSProfile(
            depth=50, durability=DurabilityPolicy.TRANSIENT_LOCAL)))
        each.start('/map')
    wait_until(lambda: all(len(maps) >= 3 for maps in heard), timeout=40, what='all maps')
    # a message that is sent back would be under way by then
    publishers[0].publish(OccupancyGrid(data=[9]))
    wait_until(lambda: all(9 in [one.data[0] for one in maps] for maps in heard), timeout=20,
               what='a new map')
    for maps in heard:
        assert sorted(message.data[0] for message in maps) == [0, 1, 2, 9]


def test_qos_of_publishers_is_kept(robot: Callable[[str], Robot]) -> None:
    one, two = robot('one'), robot('two')
    one.start('/fast')
    two.start('/fast')
    heard = two.heard(String, '/fast', BEST_EFFORT)
    reliable = two.heard(String, '/fast')
    publisher = one.publisher(String, '/fast', BEST_EFFORT)
    repeated(publisher, lambda number: String(data='fast'), heard)
    assert reliable == []
    profiles = [info.qos_profile for info in two.node.get_publishers_info_by_topic('/fast')]
    assert [each.reliability for each in profiles] == [ReliabilityPolicy.BEST_EFFORT]
    # a publisher with another QoS changes it for the other robots too
    one.node.destroy_publisher(publisher)
    repeated(one.publisher(String, '/fast'), lambda number: String(data='sure'), reliable)


def test_type_of_another_robot_has_to_match(robot: Callable[[str], Robot]) -> None:
    one, two = robot('one'), robot('two')
    one.start('/count')
    two.start('/count')
    wrong = two.heard(Int32, '/count')
    publisher = one.publisher(String, '/count')

    def look() -> bool:
        publisher.publish(String(data='three'))
        return any('so it is not shared' in line for line in two.lines)

    wait_until(look, timeout=40, what='the warning')
    assert wrong == []


@contextlib.contextmanager
def stranger(folder: Path, *data: bytes) -> Iterator[list[bool]]:
    """Stand for a hijacked machine, whose relay sends ``data``; yield its connections' fates."""
    folder.mkdir()
    fates: list[bool] = []
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(folder / NAME))
        server.listen()

        def answer(connection: socket.socket) -> None:
            with connection:
                try:
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


@pytest.mark.parametrize('data', [
    b'[' * 3000, b'\x00\xff\n', b'{"topic": 3}\n',
    encode('/chat', Form('std_msgs/msg/String', True, 0), 999_999_999),
], ids=['nested', 'binary', 'mapping', 'too-large'])
def test_hijacked_relay_is_left_and_others_go_on(
    robot: Callable[[str], Robot], data: bytes,
) -> None:
    one, two = robot('one'), robot('two')
    with stranger(one.fleet / 'evil', data) as fates:
        one.start('/chat')
        two.start('/chat')
        wait_until(lambda: True in fates, timeout=40, what='the relays to leave')
        repeated(one.publisher(String, '/chat'), lambda number: String(data='go on'),
                 two.heard(String, '/chat'))
    assert any('shares no messages' in line for line in one.lines)


def test_message_after_a_quick_change_of_qos_arrives(robot: Callable[[str], Robot]) -> None:
    one = robot('one')
    heard = one.heard(String, '/chat')
    data = b'\0\1\0\0\2\0\0\0b\0'
    with stranger(one.fleet / 'other', *(
            encode('/chat', Form('std_msgs/msg/String', True, kept), len(data)) + data
            for kept in (0, 1))):
        one.start('/chat')
        wait_until(lambda: one.node.get_publishers_info_by_topic('/chat') and any(
            info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            for info in one.node.get_publishers_info_by_topic('/chat')), timeout=40,
            what='the new QoS')
        late = one.heard(String, '/chat', LATCHED)
        wait_until(lambda: bool(late), timeout=20, what='the message')
    assert {message.data for message in (*heard, *late)} == {'b'}


def test_foreign_types_and_links_reach_nothing(robot: Callable[[str], Robot]) -> None:
    one, two = robot('one'), robot('two')
    (one.fleet / 'link').mkdir()
    (one.fleet / 'link' / NAME).symlink_to(one.folder / NAME)
    (one.fleet / 'file').mkdir()
    (one.fleet / 'file' / NAME).write_text('no socket')
    forged = [encode(topic, Form(kind, True, 1), 4) + b'\0\1\0\0' for topic, kind in (
        ('/secret', 'std_msgs/msg/String'), ('/chat', 'antigravity/msg/String'),
        ('/chat', 'json/msg/String'), ('/chat', 'std_msgs/msg/NoSuch'))]
    with stranger(one.fleet / 'evil', *forged):
        one.start('/chat')
        two.start('/chat')
        wait_until(lambda: any("'json/msg/String'" in line for line in one.lines), timeout=40,
                   what='the warning')
        repeated(two.publisher(String, '/chat'), lambda number: String(data='go on'),
                 one.heard(String, '/chat'))
        names = [name for name, _ in one.node.get_topic_names_and_types()]
    assert '/secret' not in names


def test_relay_without_its_folder_says_why(robot: Callable[[str], Robot]) -> None:
    one = robot('one')
    one.folder.rmdir()
    one.start('/chat')
    assert one.relay is not None and one.relay.wait(20) == 1
    wait_until(lambda: any('made without share=' in line for line in one.lines), timeout=10,
               what='the reason')


def test_relay_that_was_killed_starts_again(robot: Callable[[str], Robot]) -> None:
    one, two = robot('one'), robot('two')
    one.start('/chat')
    two.start('/chat')
    heard = two.heard(String, '/chat')
    publisher = one.publisher(String, '/chat')
    repeated(publisher, lambda number: String(data='before'), heard)
    assert one.relay is not None
    one.relay.kill()
    one.relay.wait(10)
    one.start('/chat')
    repeated(publisher, lambda number: String(data='after'), heard, len(heard) + 5)
    assert heard[-1].data == 'after'
