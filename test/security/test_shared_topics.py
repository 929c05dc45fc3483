# SPDX-License-Identifier: Apache-2.0
"""Relays of shared topics: a machine reads as itself alone, and only what it was made for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import contextlib
import os
from pathlib import Path
import socket
from typing import BinaryIO

import pytest

pytest.importorskip('rclpy', reason='neither ROS 2 nor the embedded default is installed')
from std_msgs.msg import String

from fogros2.waiting import wait_until
from fogros2_share import node, wire
from fogros2_share.node import MOST, NAME, OWN, PART, PROOF, Reader, TOPICS
from rigs.sharing import LATCHED, repeated, Robot, robot

__all__ = ['robot']
Robots = Callable[[str], Robot]


@contextlib.contextmanager
def reading(one: Robot, name: str = '', files: Sequence[int] = ()) -> Iterator[socket.socket]:
    """Connect to a robot's relay; say a machine's name and hand over files, as a relay does."""
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(str(one.folder / OWN / NAME))  # waits for room in the queue of connections
        link.settimeout(60)
        if name:
            socket.send_fds(link, [name.encode()], list(files))
        yield link


@contextlib.contextmanager
def proof(machine: Path, to: str, flags: int = os.O_RDWR) -> Iterator[int]:
    """Yield a file that proves to the machine ``to`` which machine this is."""
    path = machine / OWN / PROOF.format(to)
    path.touch(0o600)
    file = os.open(path, flags)
    yield file
    os.close(file)


def topic(stream: BinaryIO) -> str:
    """Return the topic of the next message."""
    found, _, size = wire.decode(stream.readline())
    stream.read(size)
    return found


def started(one: Robot) -> None:
    wait_until((one.folder / OWN / NAME).exists, timeout=60, what='the relay')


def test_link_in_place_of_a_socket_is_not_followed(robot: Robots, tmp_path: Path) -> None:
    """It would connect a relay to any socket of its own machine, and publish what that sends."""
    one, two = robot('one'), robot('two')
    (one.fleet / 'evil' / OWN).mkdir(parents=True)
    with socket.socket(socket.AF_UNIX) as trap:
        trap.bind(str(one.fleet / 'evil' / 'trap'))
        trap.listen()
        trap.setblocking(False)
        (one.fleet / 'evil' / OWN / NAME).symlink_to(one.fleet / 'evil' / 'trap')
        one.start('/chat')
        two.start('/chat')
        repeated(one.publisher(String, '/chat'), lambda number: String(data='go on'),
                 two.heard(String, '/chat'), 20)
        with pytest.raises(BlockingIOError):
            trap.accept()


def test_account_that_is_no_relay_reads_nothing(robot: Robots) -> None:
    """
    Another account of a machine cannot open the file that proves which machine it is.

    A machine has one reader, which gets the topics that the machine was made for.
    """
    one, two = robot('one'), robot('two')
    (two.folder / TOPICS).write_text('/chat\n/other')
    chat, secret = (one.publisher(String, name, LATCHED) for name in ('/chat', '/secret'))
    one.start('/secret', '/chat')
    chat.publish(String(data='latched'))
    started(one)
    with proof(two.folder, 'one', os.O_RDONLY) as read_only, proof(two.folder, 'x') as other, \
            proof(one.folder, 'two') as own, proof(two.folder, 'one') as right:
        wrong: list[tuple[str, list[int]]] = [
            ('two', []), ('two', [read_only]), ('two', [other]), ('two', [own]), ('one', [right]),
            ('../one', [right]), ('.', [right]), ('nobody', [right]), ('\x00', [right])]
        for name, files in wrong:
            with reading(one, name, files) as link:
                assert link.recv(1) == b'', (name, files)
        with contextlib.ExitStack() as undo:
            links = [undo.enter_context(reading(one, 'two', [right])) for _ in range(5)]
            for link in links[:-1]:
                while link.recv(100):  # until a newer one takes its place
                    pass
            with links[-1].makefile('rb') as stream:
                for number in range(10):
                    secret.publish(String(data=f'secret {number}'))
                    chat.publish(String(data=f'chat {number}'))
                    assert topic(stream) == '/chat'


def test_silent_connections_shut_nobody_out(robot: Robots) -> None:
    one, two = robot('one'), robot('two')
    one.start('/chat')
    started(one)
    with contextlib.ExitStack() as undo:
        for _ in range(3 * MOST):
            undo.enter_context(reading(one))
        two.start('/chat')
        repeated(one.publisher(String, '/chat'), lambda number: String(data='go on'),
                 two.heard(String, '/chat'))


def test_small_messages_that_wait_take_little_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(node, 'WAITING', 1 << 20)
    ours, theirs = socket.socketpair()
    with theirs:
        reader = Reader(ours, frozenset(), [])
        for _ in range(20_000):
            reader.put(b'head', b'data')
        assert 0 < len(reader._waiting) <= (1 << 20) / PART + 2
        theirs.settimeout(0.01)

        def comes(last: bytes) -> bool:
            reader.put(last)  # dropped until there is room again
            with contextlib.suppress(TimeoutError):
                return theirs.recv(1 << 16).endswith(last)
            return False

        wait_until(lambda: comes(b'the last one'), timeout=60, longest=0.01, what='room')
        reader.close()
