# SPDX-License-Identifier: Apache-2.0
"""What relays of shared topics send each other, and which messages are their own; by value."""

from __future__ import annotations

from hypothesis import given, settings, strategies
import pytest

from fogros2_share.wire import decode, DEEPEST, Echoes, encode, Form, LARGEST, LINE

MAP = Form('nav_msgs/msg/OccupancyGrid', True, 1)


def test_message_arrives_as_it_was_sent() -> None:
    assert decode(encode('/map', MAP, 3)) == ('/map', MAP, 3)
    other = Form('sensor_msgs/msg/LaserScan', False, 0)
    assert decode(encode('/scan', other, 0)) == ('/scan', other, 0)
    assert len(encode('/' + 'a' * 255, MAP, LARGEST)) < LINE


@pytest.mark.parametrize('line', [
    '/map a_msgs/msg/Grid 1 1', '', '{}', '/map a_msgs/msg/Grid 1 1 3 4',
    'map a_msgs/msg/Grid 1 1 3', '/map a_msgs/msg/Grid 2 1 3', '/map a_msgs/msg/Grid 1 -1 3',
    '/map a_msgs/msg/Grid 1 1 -3',
    '/map a_msgs/msg/Grid 1 1 3.0', f'/map a_msgs/msg/Grid 1 1 {LARGEST + 1}',
    f'/map a_msgs/msg/Grid 1 {DEEPEST + 1} 3', '/map os/path 1 1 3', '/map os.path/msg/A 1 1 3',
    '/map ../msg/A 1 1 3', '/map a/srv/A 1 1 3', '/map a_msgs/msg/Grid 1 1 ٣'])
def test_wrong_header_ends_the_connection(line: str) -> None:
    with pytest.raises(ValueError):
        decode(f'{line}\n'.encode())
    # the same, without the mistake
    assert decode(b'/map a_msgs/msg/Grid 1 1 3\n') == ('/map', Form('a_msgs/msg/Grid', True, 1), 3)


@settings(deadline=None)
@given(strategies.one_of(
    strategies.binary(max_size=2 * LINE), strategies.lists(strategies.one_of(
        strategies.text(), strategies.integers().map(str), strategies.just(MAP.kind)),
        max_size=6).map(lambda words: f'/map {" ".join(words)}\n'.encode(errors='replace'))))
def test_anything_is_a_message_or_a_value_error(line: bytes) -> None:
    try:
        _, form, size = decode(line)
    except ValueError:
        return
    assert 0 <= size <= LARGEST and 0 <= form.kept <= DEEPEST


def test_own_message_is_heard_once() -> None:
    echoes = Echoes()
    assert not echoes.heard(0.0, b'a')
    echoes.add(0.0, b'a')
    echoes.add(0.1, b'a')
    assert not echoes.heard(0.2, b'b')
    assert [echoes.heard(0.2, b'a') for _ in range(3)] == [True, True, False]


def test_new_subscription_hears_latched_messages_once_more() -> None:
    echoes = Echoes()
    echoes.add(0.0, b'a')
    echoes.add(0.0, b'lost with the old subscription')
    echoes.restart(0.1, [hash(b'a')])
    assert [echoes.heard(0.2, b'a') for _ in range(2)] == [True, False]
    assert not echoes.heard(0.2, b'lost with the old subscription')


def test_message_of_long_ago_is_no_echo() -> None:
    echoes = Echoes()
    echoes.add(0.0, b'a')
    echoes.add(4.0, b'a')
    # the first one was never heard; a node has the second content by itself later
    assert echoes.heard(5.5, b'a')
    assert not echoes.heard(5.6, b'a')
    echoes.add(6.0, b'b')
    assert not echoes.heard(6.0 + Echoes.DELAY + 0.1, b'b')


def test_echoes_that_nobody_hears_are_forgotten() -> None:
    echoes = Echoes()
    for number in range(3 * Echoes.MOST):
        echoes.add(number / 100, str(number).encode())
    assert len(echoes._published) <= Echoes.MOST
    last = 3 * Echoes.MOST - 1
    assert echoes.heard(last / 100, str(last).encode())
