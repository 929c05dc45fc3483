# SPDX-License-Identifier: Apache-2.0
"""Which messages of replicas are forwarded, by value."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from fogros2_replicas.pairs import HELD, MISSES, Pair, SET_BACK, STREAK

NAMES = ('a', 'b', 'c')


@pytest.fixture
def pair():
    """Return a pair whose stamps have matched."""
    pair = Pair(NAMES)
    pair.input(0.0, (1, ''))
    assert pair.output(0.1, 'a', (1, ''))
    return pair


def test_first_output_of_a_stamp_is_forwarded(pair):
    pair.input(1.0, (2, ''))
    assert [pair.output(1.1, name, (2, 'x')) for name in 'bac'] == [True, False, False]
    assert pair.replicas['b'].latency == pytest.approx(0.1)


def test_output_older_than_the_newest_is_dropped(pair):
    assert pair.output(1.0, 'b', (5, ''))
    assert not pair.output(1.1, 'a', (4, ''))


def test_nth_output_of_a_key_is_forwarded_once(pair):
    """A node that publishes three messages for each image."""
    came = [('a', 'l'), ('b', 'l'), ('b', 'l'), ('a', 'l'), ('b', 'r'), ('a', 'l'), ('a', 'r')]
    assert [pair.output(1.0, name, (9, frame)) for name, frame in came] == [
        True, False, True, False, True, True, False]


def test_time_that_is_set_back_begins_again(pair):
    pair.input(1.0, (5 * SET_BACK, ''))
    assert pair.output(1.0, 'a', (5 * SET_BACK, ''))
    pair.input(2.0, (SET_BACK, ''))
    assert pair.output(2.1, 'a', (SET_BACK, ''))


@pytest.mark.parametrize('header', [None, (0, ''), (77, '')])
def test_outputs_without_match_come_from_one_replica(header):
    pair = Pair(NAMES)
    forwarded = []
    for number in range(MISSES):
        pair.input(number, (1000 + number, ''))
        forwarded += [name for name in 'bac' if pair.output(number, name, header)]
        assert pair.unmatched == (3 * (number + 1) >= MISSES)
    assert forwarded == ['b'] * MISSES


def test_silent_replica_is_replaced_without_stamps():
    pair = Pair(NAMES)
    assert pair.output(0.0, 'a', None)
    assert [pair.output(1.0, 'b', None) for _ in range(STREAK + 1)] == [False, False, True, True]
    assert not pair.output(2.0, 'a', None)


def test_dead_replica_is_replaced_at_once():
    pair = Pair(NAMES)
    assert pair.output(0.0, 'a', None)
    pair.died('a')
    assert pair.output(0.1, 'c', None)
    assert pair.replicas['a'].failures == 1


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from(NAMES), st.integers(1, 4), st.sampled_from('lr'))))
def test_forwarded_is_what_the_fastest_sent(messages):
    """Stamps never go back, and of each key as many come as the most eager replica sent."""
    pair = Pair(NAMES)
    for stamp in range(1, 5):
        pair.input(0.0, (stamp, ''))
    forwarded = [(name, stamp, frame) for name, stamp, frame in messages
                 if pair.output(1.0, name, (stamp, frame))]
    stamps = [stamp for _, stamp, _ in forwarded]
    assert stamps == sorted(stamps)
    newest = max((stamp for _, stamp, _ in messages), default=0)
    first = next((i for i, one in enumerate(messages) if one[1] == newest), 0)
    for frame in 'lr':
        sent = [sum(one == (name, newest, frame) for one in messages[first:]) for name in NAMES]
        assert sum(one[1:] == (newest, frame) for one in forwarded) == max(sent)


# -- a last replica -------------------------------------------------------------------------------

@pytest.fixture
def robot():
    """Return a pair of two machines and the robot, which gets inputs after 0.2 s."""
    pair = Pair(['a', 'b', 'robot'], 'robot', 0.2)
    for replica in pair.replicas.values():
        replica.there = True
    return pair


def test_robot_gets_no_input_that_a_machine_answers(robot):
    for stamp in range(1, 50):
        assert robot.input(stamp, (stamp, ''), b'x') == []
        assert robot.next_due() == stamp + 0.2
        assert robot.output(stamp + 0.1, 'b', (stamp, ''))
        assert robot.next_due() == float('inf') and robot.due(stamp + 0.3) == []


def test_robot_gets_late_inputs_then_all_at_once(robot):
    robot.input(1.0, (1, ''), b'1')
    robot.input(1.1, (2, ''), b'2')
    assert robot.due(1.25) == [b'1'] and robot.next_due() == 1.3
    assert robot.output(1.27, 'robot', (1, ''))
    assert robot.input(1.28, (3, ''), b'3') == [b'3']
    assert robot.due(1.3) == [b'2']
    # a machine's output that is late too changes nothing, one in time does
    assert not robot.output(1.4, 'a', (1, ''))
    assert robot.input(1.5, (4, ''), b'4') == [b'4']
    assert robot.output(1.6, 'a', (4, ''))
    assert robot.input(1.7, (5, ''), b'5') == []


def test_an_output_answers_the_inputs_before_it(robot):
    for stamp in (1, 2, 3):
        robot.input(0.01 * stamp, (stamp, ''), b'x')
    robot.output(0.1, 'a', (2, ''))
    assert robot.next_due() == pytest.approx(0.23)
    assert robot.due(0.3) == [b'x']


def test_robot_alone_gets_all_inputs(robot):
    robot.died('a')
    robot.replicas['b'].there = False
    assert robot.input(1.0, None, b'x') == [b'x'] and robot.due(9.0) == []


def test_outputs_without_stamps_answer_all_inputs(robot):
    assert robot.input(1.0, None, b'1') == robot.input(1.1, None, b'2') == []
    robot.output(1.15, 'a', None)
    assert robot.due(9.0) == []


def test_few_inputs_are_held_for_the_robot(robot):
    for stamp in range(1, 200):
        robot.input(1.0, (stamp, ''), b'%d' % stamp)
    assert robot.due(2.0) == [b'%d' % stamp for stamp in range(1, HELD + 1)]


def test_robot_gets_inputs_that_come_faster_than_it_holds_them(robot):
    got = []
    for number in range(200):
        now = 0.001 * number
        got += robot.due(1.0 + now) + robot.input(1.0 + now, (number + 1, ''), b'%d' % number)
    assert got == [] and len(robot.due(1.25)) == HELD
    assert robot.input(1.3, (999, ''), b'x') == [b'x']


def test_replicas_without_a_last_one_hold_nothing(pair):
    assert pair.input(1.0, (2, ''), b'x') == [] and pair.due(9.0) == []
