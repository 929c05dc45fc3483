# SPDX-License-Identifier: Apache-2.0
"""The robot's queue of action chunks, and the matching of observations by stamps."""

from __future__ import annotations

import numpy
import pytest

from fogros2_examples.policy.chunks import Chunk, Queue, SECOND
from fogros2_examples.policy.matching import Matcher

MS = SECOND // 1000
#: A time of today's clocks, where floating-point numbers are 256 ns apart.
START = 1_800_000_000 * SECOND


def chunk(stamp, *values, apart=100):
    """Return actions of two joints; stamps and times in ms after START."""
    return Chunk(START + stamp * MS, numpy.arange(len(values)) * float(apart * MS),
                 numpy.array([[value, -value] for value in values], float))


def queue(*stamps, blend=0, longest=10_000, velocity=False):
    made = Queue(blend * MS, longest * MS, velocity)
    for stamp in stamps:
        made.observe(START + stamp * MS)
    return made


def at(made, ms, measured=None):
    """Return value, age in ms and whether the robot is commanded by a chunk; None for nothing."""
    command = made.command(START + round(ms * MS), measured)
    if command is None:
        return None
    age = None if command.stamp is None else round((START - command.stamp) / MS + ms)
    return pytest.approx(float(command.values[0]), abs=1e-6), age


def test_action_is_interpolated_at_the_robots_time():
    made = queue(0)
    made.add(chunk(0, 0, 10, 30), START + 40 * MS)
    assert [at(made, ms) for ms in (40, 100, 150, 200)] == [
        (4, 40), (10, 100), (20, 150), (30, 200)]


def test_nothing_is_commanded_before_the_first_chunk():
    assert at(queue(0), 50) is None


@pytest.mark.parametrize('measured, velocity, expected', [
    (numpy.array([7.0, 8.0]), False, 7), (None, False, 30),
    (numpy.array([7.0, 8.0]), True, 0), (None, True, 0)])
def test_no_action_is_executed_past_the_horizon(measured, velocity, expected):
    made = queue(0, velocity=velocity)
    made.add(chunk(0, 0, 10, 30), START)
    assert at(made, 200) == (30, 200)
    assert at(made, 200.001, measured) == (expected, None)
    # and the robot stays where it stopped, wherever it is measured then
    assert at(made, 300, numpy.array([9.0, 9.0])) == (expected, None)


def test_robot_moves_again_with_the_next_chunk():
    made = queue(0, 500)
    made.add(chunk(0, 1, 1), START)
    assert at(made, 50) == (1, 50)
    assert at(made, 400)[1] is None
    made.add(chunk(500, 5, 5), START + 520 * MS)
    assert at(made, 530) == (5, 30)


def test_new_chunk_takes_over_linearly():
    made = queue(0, 100, blend=100)
    made.add(chunk(0, *[0] * 11), START)
    assert at(made, 190) == (0, 190)
    made.add(chunk(100, *[10] * 11), START + 200 * MS)
    assert [at(made, ms) for ms in (200, 250, 300, 400)] == [
        (0, 200), (5, 200), (10, 200), (10, 300)]


def test_overlapping_chunks_blend_without_a_jump():
    """Thirty chunks a second, each elsewhere, move the command by small steps only."""
    chance = numpy.random.default_rng(1)
    made = queue(blend=200)
    values = []
    for ms in range(0, 4000, 11):
        if ms % 33 == 0:
            made.observe(START + ms * MS)
            made.add(chunk(ms, *[float(chance.uniform(-1, 1))] * 20), START + ms * MS)
        values.append(made.command(START + ms * MS, None).values[0])
    # without blending, two in three chunks would jump by more than a third
    assert max(abs(numpy.diff(values))) < 0.3
    assert len(made._chunks) <= 8


def test_blending_ends_with_the_old_chunks_horizon():
    """A chunk that takes over late has done so when the old one has no action any more."""
    made = queue(0, 60, blend=1000)
    made.add(chunk(0, 0, 0), START)
    made.add(chunk(60, 10, 10, 10), START + 60 * MS)
    assert [at(made, ms)[0] for ms in (60, 80, 99, 101)] == [0, 5, 9.75, 10]


@pytest.mark.parametrize('stamp, now, reason', [
    (50, 60, 'no observation that this robot made'), (0, 60, 'newer one'),
    (100, 99, 'future'), (100, 301, 'are over'), (200, 210, 'more than 0.15 s')])
def test_chunk_is_refused_by_the_robots_stamps(stamp, now, reason):
    made = queue(0, 20, 100, 200, longest=200 if stamp != 200 else 150)
    if stamp == 0:
        made.add(chunk(20, 1, 1), START + 50 * MS)
    before = at(made, now)
    with pytest.raises(ValueError, match=reason):
        made.add(chunk(stamp, 5, 6, 7), START + now * MS)
    assert at(made, now) == before


def test_clock_that_is_set_back_stops_then_continues():
    made = queue(100_000, 10)
    made.add(chunk(100_000, 1, 1, 1), START + 100_050 * MS)
    assert at(made, 100_060)[1] == 60
    # an hour earlier, the chunk is of the future
    assert at(made, 5)[1] is None
    made.add(chunk(10, 2, 2, 2), START + 15 * MS)
    assert at(made, 20) == (2, 10)


def test_stamps_and_chunks_are_bounded():
    made = queue(*range(9000), blend=10_000_000, longest=20_000)
    assert len(made._stamps) == 8192
    for number in range(8000, 8200):
        made.add(chunk(number, *[1] * 100), START + number * MS)
    assert len(made._chunks) == 64


def matcher(tolerance=20, **most):
    return Matcher(most or {'a': 8, 'b': 8, 'joints': 100}, tolerance * MS)


def added(made, **stamps):
    for name, several in stamps.items():
        for ms in several:
            made.add(name, START + ms * MS, ms)
    return made.newest()


def test_observation_has_the_nearest_message_of_each_topic():
    made = matcher()
    assert added(made, a=[0, 33, 66]) is None
    assert added(made, b=[5, 38]) is None
    assert added(made, joints=range(0, 60, 10)) == {'a': 33, 'b': 38, 'joints': 30}
    assert made.newest() is None


def test_newest_complete_observation_is_taken():
    made = matcher()
    assert added(made, a=[0, 33, 66, 99], b=[0, 33, 66], joints=[0, 33, 66, 99])['a'] == 66
    # an older one that is complete by now is of no use
    assert added(made, b=[34]) is None
    assert added(made, b=[99])['a'] == 99


@pytest.mark.parametrize('apart, matched', [(20, True), (21, False)])
def test_tolerance_limits_what_belongs_together(apart, matched):
    assert (added(matcher(), a=[100], b=[100 - apart], joints=[100]) is not None) == matched


def test_camera_that_is_silent_stops_the_observations():
    made = matcher()
    assert added(made, a=[0], b=[0], joints=[0]) is not None
    assert all(added(made, a=[ms], joints=[ms]) is None for ms in range(33, 2000, 33))
    assert added(made, b=[1980])['a'] == 1980


def test_waiting_messages_are_bounded():
    made = matcher()
    added(made, a=range(1000), joints=range(1000))
    assert {name: len(waiting) for name, waiting in made._waiting.items()} == {
        'a': 8, 'b': 0, 'joints': 100}


def test_matching_continues_when_the_robots_clock_is_set_back():
    made = matcher()
    assert added(made, a=[100_000], b=[100_000], joints=[100_000]) is not None
    assert added(made, a=[10], b=[10], joints=[10])['a'] == 10
