# SPDX-License-Identifier: Apache-2.0
"""Images that cross the VPN as they are: when a launch looks for them, and what it says."""

from __future__ import annotations

import os
import threading

import pytest

from fogros2.errors import Cancelled, DeadlineExceeded
from fogros2.model import NodeSpec
from fogros2.runtime.node_spec import full_name
from fogros2_features.streams import uncompressed

INTERVAL = 5.0


class Ended(threading.Event):
    """The end of a launch after so many intervals, which take no time."""

    def __init__(self, intervals: int) -> None:
        super().__init__()
        self.left = intervals

    def wait(self, timeout: float | None = None) -> bool:
        self.left -= 1
        return self.left < 0


def warnings(rates: list[float], looks: list[list[str]]) -> tuple[list[str], int]:
    """
    Return what a launch warns of, and how often it looks at the graph.

    :param rates: bits per second on the VPN in each interval.
    :param looks: the image topics that each look finds.
    """
    counts = [0]
    for rate in rates:
        counts.append(counts[-1] + int(rate * INTERVAL / 8))
    counter, found = iter(counts), iter(looks)
    said: list[str] = []
    times = 0

    def look() -> list[str]:
        nonlocal times
        times += 1
        return next(found)

    uncompressed.watch(lambda: next(counter), look, said.append, Ended(len(rates)), INTERVAL)
    return said, times


def test_image_topic_is_named_once_with_its_rate() -> None:
    said, times = warnings([0, 90e6, *[90e6] * 30], [['/camera/image_raw']] * 3)
    assert said == ['/camera/image_raw crosses the VPN uncompressed at 90 Mbit/s: '
                    'add it to stream_topics']
    assert times == 3


def test_topic_that_joins_later_is_named_too() -> None:
    said, _ = warnings([90e6] * (1 + uncompressed.PAUSE), [['/a'], ['/c', '/b', '/a']])
    assert said[1] == ('/b, /c cross the VPN uncompressed at 90 Mbit/s: '
                       'add them to stream_topics')


def test_graph_is_not_looked_at_while_vpn_is_quiet() -> None:
    assert warnings([uncompressed.BUSY / 2] * 50, []) == ([], 0)


def test_launch_without_vpn_interface_is_not_watched() -> None:
    said: list[str] = []
    uncompressed.watch(lambda: uncompressed.carried('fognone'), lambda: [], said.append,
                       Ended(3))
    assert said == []


@pytest.mark.parametrize(('line', 'topics'), [
    ('{"streams": [], "topics": [{"topic": "/c", "type": "sensor_msgs/msg/Image"}, '
     '{"topic": "/scan", "type": "sensor_msgs/msg/LaserScan"}]}', ['/c']),
    ('{"picture": "/c", "note": "x"}', []), ('a warning of a library', []), ('3', [])])
def test_only_image_topics_of_a_line_count(line: str, topics: list[str]) -> None:
    assert uncompressed.images(line) == topics


@pytest.mark.parametrize(('words', 'name'), [
    (('--ros-args', '-r', '__node:=slam'), 'slam'), ((), 'slam_node')])
def test_node_is_known_by_its_name_in_graph(words: tuple[str, ...], name: str) -> None:
    node = NodeSpec('id', 'label', package='slam', executable='slam_node', arguments=words)
    assert full_name(node) == f'/{name}'


def test_look_ends_with_the_launch() -> None:
    ended = threading.Event()
    ended.set()
    with pytest.raises(Cancelled):
        uncompressed.crossing_images({}, os.environ, ended)


def test_look_that_fails_ends_the_watch() -> None:
    def look() -> list[str]:
        raise DeadlineExceeded('look for images that cross the VPN')

    counter = iter(range(0, 10 ** 12, 10 ** 9))
    said: list[str] = []
    uncompressed.watch(lambda: next(counter), look, said.append, Ended(5), INTERVAL)
    assert said == []
