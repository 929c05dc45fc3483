# SPDX-License-Identifier: Apache-2.0
"""Topics with a limited rate: both ends of a link in one ROS domain, and with a machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time
from typing import Any
import uuid

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Int32, String

from fogros2 import process
from fogros2.waiting import wait_until
from fogros2_features.streams.policy import Policy
from rigs.launched import launching
from rigs.sharing import LATCHED, repeated, Robot, robot

__all__ = ['robot']
ROOT = Path(__file__).parents[2]
THERE = '/fogros2/planner'


@pytest.fixture
def one(robot: Callable[[str], Robot]) -> Robot:
    return robot('one')


@pytest.fixture
def limited(one: Robot) -> Iterator[Callable[..., None]]:
    """Return what starts the ends of a link with limits; they end without an error."""
    ends: list[subprocess.Popen[bytes]] = []

    def start(**limits: float) -> None:
        policy = Policy(limits={f'/{topic}': rate for topic, rate in limits.items()})
        for _, node in policy.ends('planner'):
            ends.append(subprocess.Popen(
                [sys.executable, str(ROOT / 'fogros2_share/scripts/limits'),
                 str(node.arguments[0])],
                env=one.environment,
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)))

    yield start
    for end in ends:
        end.send_signal(signal.SIGINT)
    assert [end.wait(60) for end in ends] == [0] * len(ends)


def timed(one: Robot, kind: Any, topic: str) -> list[tuple[float, Any]]:
    """Return messages with the times at which the test's node hears them, a list that grows."""
    heard: list[tuple[float, Any]] = []
    one.node.create_subscription(
        kind, topic, lambda message: heard.append((time.monotonic(), message)), 100)
    return heard


def test_both_directions_have_the_rate_and_no_echo(
        one: Robot, limited: Callable[..., None]) -> None:
    limited(count=10, mixed=10)
    # a topic with two types stops no other: a process has one type of a topic with Fast DDS
    for kind, topic in ((String, '/mixed'), (Int32, f'{THERE}/mixed')):
        one.publisher(kind, topic)
        one.heard(kind, topic)
    here, there = timed(one, Int32, '/count'), timed(one, Int32, f'{THERE}/count')
    up, down = (one.publisher(Int32, topic) for topic in ('/count', f'{THERE}/count'))
    came_up: list[float] = []
    came_down: list[float] = []
    sent = 0

    def look() -> bool:
        nonlocal sent
        sent += 1
        up.publish(Int32(data=sent))
        down.publish(Int32(data=-sent))
        came_up[:] = [at for at, message in list(there) if message.data > 0]
        came_down[:] = [at for at, message in list(here) if message.data < 0]
        return min(len(came_up), len(came_down)) >= 30

    wait_until(look, timeout=60, longest=0.01, what='30 messages each way')
    for came in (came_up, came_down):
        # a busy computer delivers some late; without a limit 30 take 0.3 s
        assert len(came) <= 10 * (came[-1] - came[0]) + 10
    # the last ones arrive, and each publisher's own side has heard each once
    wait_until(lambda: all({sent, -sent} <= {message.data for _, message in heard}
                           for heard in (here, there)), timeout=60, what='the last messages')
    for heard in (here, there):
        numbers = [message.data for _, message in heard]
        assert len(numbers) == len(set(numbers))


def test_topic_crosses_while_the_other_side_subscribes(
        one: Robot, limited: Callable[..., None]) -> None:
    limited(map=5)
    grids = one.publisher(OccupancyGrid, '/map', LATCHED)
    grids.publish(OccupancyGrid(data=[7]))

    def link() -> int:
        return one.node.count_subscribers(f'{THERE}/map/from_robot')

    wait_until(lambda: one.node.count_publishers(f'{THERE}/map') > 0, timeout=60,
               what='the publisher there')
    assert link() == 0
    # a latched message crosses for a subscriber that comes later
    heard: list[Any] = []
    subscription = one.node.create_subscription(
        OccupancyGrid, f'{THERE}/map', heard.append, LATCHED)
    wait_until(lambda: len(heard) == 1 and heard[0].data[0] == 7, timeout=60, what='the map')
    one.node.destroy_subscription(subscription)
    wait_until(lambda: link() == 0, timeout=60, what='the end of the subscription')


def test_transforms_are_limited_by_child_frame(one: Robot, limited: Callable[..., None]) -> None:
    """A limit of messages would pass those of the frame that is first in each period."""
    messages = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not installed')
    limited(tf=5)
    heard: list[Any] = timed(one, messages.TFMessage, f'{THERE}/tf')
    publisher = one.publisher(messages.TFMessage, '/tf')
    frames = ['base', 'arm', 'camera']

    def message(number: int) -> Any:
        transform = TransformStamped(child_frame_id=frames[number % 3])
        transform.transform.translation.x = float(number)
        return messages.TFMessage(transforms=[transform])

    repeated(publisher, message, heard, 10)
    assert len(heard) <= 5 * (heard[-1][0] - heard[0][0]) + 2
    for _, each in heard[1:]:
        assert sorted(one.child_frame_id for one in each.transforms) == sorted(frames)
        places = [one.transform.translation.x for one in each.transforms]
        assert max(places) - min(places) == 2


@pytest.mark.usefixtures('nothing_left', 'engine')
@pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH')
@pytest.mark.skipif(process.which('sshd') is None, reason='needs sshd (openssh-server)')
def test_machine_hears_less_often_or_nothing() -> None:
    with launching() as launch:
        run = launch('fogros2_examples', 'talker.limited.launch.py',
                     f'name:=limited-{uuid.uuid4().hex[:6]}')
        run.wait_for('[news_there]: I heard:', times=2)
        run.wait_for('[letters_there]: I heard:', times=2)
        begin = time.monotonic()
        run.wait_for('[letters_there]: I heard:', times=50 + len(
            run.since(0.0, '[letters_there]: I heard:')))
        end = time.monotonic()

        def heard(listener: str) -> int:
            return len(run.since(begin, f'[{listener}]: I heard:'))

        assert 2 <= heard('news_there') <= end - begin + 2
        assert heard('diary_there') == 0
        for topic in ('news', 'diary', 'letters'):
            assert heard(f'{topic}_here') >= 0.7 * heard('letters_there')
        run.interrupt()
        assert run.ended() == 0, run.text
    assert not run.errors, run.text
