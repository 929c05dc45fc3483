# SPDX-License-Identifier: Apache-2.0
"""Who gets a request, and which answer is the answer: by value, and for any order of events."""

from __future__ import annotations

from contextlib import nullcontext
import heapq
import random
from types import SimpleNamespace

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

from fogros2_replicas import figures
from fogros2_replicas.calls import Answer, BEHIND, Calls, Drop, MOST, PROBE, REFRESH, Send
from fogros2_replicas.node import FirstAnswer

NAMES = ('a', 'b', 'c')


@pytest.fixture
def calls():
    return ready(Calls(NAMES))


def ready(calls):
    assert calls.ready(0.0, calls.replicas) == []
    # so that no replica is asked only because it was not asked for long
    for replica in calls.replicas.values():
        replica.last = 0.0
    return calls


def hedged(after, latencies):
    """Return calls whose replicas have answered before, in so many milliseconds."""
    calls = ready(Calls(list(latencies), after))
    for name, latency in latencies.items():
        for _ in range(figures.ENOUGH):
            calls.replicas[name].took(latency / 1000)
    return calls


def sent(actions):
    return [action.replica for action in actions if isinstance(action, Send)]


def test_request_goes_to_all_replicas(calls):
    assert calls.ask(1.0, 1) == [Send(1, 'a'), Send(1, 'b'), Send(1, 'c')]


def test_first_answer_wins_and_late_ones_are_dropped(calls):
    calls.ask(1.0, 1)
    assert calls.answered(1.1, 1, 'b', 'first') == [Answer(1, 'first')]
    assert calls.answered(1.2, 1, 'a', 'second') == []
    assert (calls.replicas['b'].won, calls.replicas['a'].won) == (1, 0)
    assert calls.replicas['a'].latency == pytest.approx(0.2)


def test_failure_counts_when_all_have_failed(calls):
    calls.ask(1.0, 1)
    assert calls.answered(1.1, 1, 'a', 'no', failed=True) == []
    assert calls.died(1.2, 'b') == []
    assert calls.answered(1.3, 1, 'c', 'no!', failed=True) == [Answer(1, 'no!')]


def test_nearest_is_asked_first_and_next_after_delay():
    calls = hedged(50, {'a': 9, 'b': 3, 'c': 5})
    assert sent(calls.ask(1.0, 1)) == ['b']
    assert calls.next_due() == 1.05
    assert calls.due(1.049) == []
    assert sent(calls.due(1.05)) == ['c']
    assert sent(calls.due(1.1)) == ['a']
    assert calls.answered(1.11, 1, 'a', 'x') == [Answer(1, 'x')]
    assert calls.next_due() == float('inf')


def test_late_replica_is_left_out_until_it_answers():
    calls = hedged(50, {'a': 9, 'b': 3})
    calls.ask(1.0, 1)
    calls.due(1.05)
    calls.answered(1.06, 1, 'a', 'x')
    assert calls.replicas['b'].state() == 'left out'
    assert sent(calls.ask(1.1, 2)) == ['a']
    assert calls.answered(1.11, 1, 'b', 'x') == []
    assert calls.replicas['b'].state() == 'live'
    assert sent(calls.ask(1.12, 3)) == ['b']


def test_percentile_is_learned_from_answers():
    calls = ready(Calls(NAMES, 'p95'))
    for number in range(figures.ENOUGH):
        assert sent(calls.ask(number, number)) == ['a', 'b', 'c']
        for name in NAMES:
            calls.answered(number + 0.010 + 0.001 * (number % 2), number, name, 'x')
    assert len(sent(calls.ask(100.0, 100))) == 3  # all are due for a refresh
    calls.answered(100.01, 100, 'a', 'x')
    assert len(sent(calls.ask(101.0, 101))) == 1
    assert calls.next_due() == pytest.approx(101.011, abs=1e-4)


def test_requests_of_dead_replica_go_to_next_at_once():
    calls = hedged(500, {'a': 3, 'b': 9})
    calls.ask(1.0, 1)
    assert sent(calls.died(1.01, 'a')) == ['b']
    assert sent(calls.ask(1.1, 2)) == ['b']
    calls.started('a')
    assert sent(calls.ask(1.2, 3)) == ['a']


def test_replica_that_left_the_graph_is_not_waited_for():
    calls = hedged(500, {'a': 3, 'b': 9})
    calls.ask(1.0, 1)
    assert sent(calls.ready(1.1, ['b'])) == ['b']


def test_answer_sent_before_death_takes_nothing_back():
    calls = ready(Calls(('a', 'b')))
    calls.ask(1.0, 1)
    calls.died(1.1, 'a')
    assert calls.answered(1.2, 1, 'a', 'x') == [Answer(1, 'x')]
    assert calls.replicas['a'].state() == 'died'


def test_slow_replica_is_left_out_and_probed(calls):
    for number in range(BEHIND):
        assert 'c' in sent(calls.ask(1.0, number))
        calls.answered(1.001, number, 'a', 'x')
        calls.answered(1.001, number, 'b', 'x')
    assert sent(calls.ask(1.1, 100)) == ['a', 'b']
    calls.answered(1.1, 100, 'a', 'x')
    assert sent(calls.ask(1.0 + PROBE, 101)) == ['a', 'b', 'c']
    calls.answered(3.1, 101, 'a', 'x')
    assert sent(calls.ask(3.2, 102)) == ['a', 'b']
    assert calls.answered(3.3, 101, 'c', 'x') == []  # and so the 16 before it were lost
    assert sent(calls.ask(3.4, 103)) == ['a', 'b', 'c']


def test_other_replicas_are_measured_from_time_to_time():
    calls = hedged(500, {'a': 3, 'b': 9})
    assert sent(calls.ask(REFRESH - 0.1, 1)) == ['a']
    assert sent(calls.ask(REFRESH, 2)) == ['a', 'b']


def test_request_that_all_lose_goes_to_one_that_is_left_out(calls):
    calls.replicas['c'].slow, calls.replicas['c'].last = True, 1.0
    assert sent(calls.ask(1.0, 1)) == ['a', 'b']
    assert sent(calls.due(1.0 + PROBE)) == ['c']
    assert calls.replicas['a'].state() == 'live'


def test_request_without_replicas_waits_for_one():
    calls = Calls(NAMES)
    assert calls.ask(1.0, 1) == []
    assert sent(calls.ready(5.0, ['b'])) == ['b']
    assert calls.answered(5.1, 1, 'b', 'x') == [Answer(1, 'x')]


def test_request_that_all_died_with_is_sent_again():
    calls = ready(Calls(('a', 'b')))
    calls.ask(1.0, 1)
    calls.died(1.1, 'a')
    assert calls.died(1.1, 'b') == []
    calls.started('b')
    assert sent(calls.due(calls.next_due())) == ['b']


@pytest.fixture
def robot():
    """Two machines, and the robot after 200 ms."""
    return ready(Calls(['a', 'b', 'robot'], last='robot', deadline=0.2))


def test_robot_is_not_asked_while_machines_answer(robot):
    for call in range(100):
        assert {*sent(robot.ask(call, call))} == {'a', 'b'}
        assert robot.answered(call + 0.19, call, 'b', 'x') == [Answer(call, 'x')]
        robot.answered(call + 0.5, call, 'a', 'x')
    assert robot.next_due() == float('inf')


def test_robot_is_asked_at_the_deadline_and_at_once_afterwards(robot):
    robot.ask(1.0, 1)
    assert robot.next_due() == 1.2 and robot.due(1.19) == []
    assert robot.due(1.2) == [Send(1, 'robot')]
    assert robot.answered(1.25, 1, 'robot', 'own') == [Answer(1, 'own')]
    assert sent(robot.ask(1.3, 2)) == ['robot']  # the machines owe an answer
    robot.answered(1.35, 2, 'robot', 'own')
    # from time to time they get a request too, and count again when one answers it
    assert sent(robot.ask(1.0 + PROBE, 3)) == ['robot', 'a', 'b']
    assert robot.answered(1.1 + PROBE, 3, 'a', 'x') == [Answer(3, 'x')]
    assert sent(robot.ask(1.2 + PROBE, 4)) == ['a']


def test_robot_takes_what_machines_lose(robot):
    robot.ask(1.0, 1)
    assert robot.died(1.01, 'a') == []
    assert robot.died(1.02, 'b') == [Send(1, 'robot')]
    assert sent(robot.ask(1.1, 2)) == ['robot']
    assert robot.ready(1.2, ['robot']) == []  # both have left the graph
    assert sent(robot.ask(9.0, 3)) == ['robot']


def test_answer_of_a_machine_wins_after_the_deadline_too(robot):
    robot.ask(1.0, 1)
    robot.due(1.2)
    assert robot.answered(1.21, 1, 'a', 'x') == [Answer(1, 'x')]
    assert robot.answered(1.3, 1, 'robot', 'own') == []
    # and yet it was late; the next answer in time counts
    assert sent(robot.ask(2.0, 2)) == ['robot']
    assert sent(robot.ask(1.0 + PROBE, 3)) == ['robot', 'a', 'b']
    robot.answered(1.1 + PROBE, 3, 'a', 'x')
    assert sent(robot.ask(1.2 + PROBE, 4)) == ['a']


def test_silent_machine_stays_late_while_the_robot_works(robot):
    robot.ask(1.0, 1)
    assert sent(robot.due(1.2)) == ['robot']
    robot.due(1.2 + PROBE)
    assert robot.replicas['a'].late and robot.replicas['b'].late


def test_machines_are_hedged_before_the_robot():
    calls = ready(Calls(['a', 'b', 'robot'], 50, 'robot', 0.2))
    for name in 'ab':
        calls.replicas[name].took(0.01)
    assert sent(calls.ask(1.0, 1)) == ['a']
    assert sent(calls.due(1.05)) == ['b']
    assert calls.due(1.1) == [] and calls.next_due() == 1.2
    assert sent(calls.due(1.2)) == ['robot']


def test_failure_of_all_machines_is_not_the_last_word(robot):
    robot.ask(1.0, 1)
    robot.answered(1.1, 1, 'a', 'no', failed=True)
    assert robot.answered(1.1, 1, 'b', 'no', failed=True) == [Send(1, 'robot')]
    assert robot.answered(1.2, 1, 'robot', 'yes') == [Answer(1, 'yes')]


def test_failure_of_the_robot_is_an_answer(robot):
    robot.ask(1.0, 1)
    robot.due(1.2)
    assert robot.answered(1.3, 1, 'robot', 'no', failed=True) == [Answer(1, 'no')]
    assert robot.answered(1.4, 1, 'a', 'x') == []


def test_robot_without_its_copy_waits_for_a_machine():
    calls = Calls(['a', 'robot'], last='robot', deadline=0.2)
    calls.ready(0.0, ['a'])
    assert sent(calls.ask(1.0, 1)) == ['a']
    assert calls.due(1.2) == []
    assert calls.answered(1.4, 1, 'a', 'x') == [Answer(1, 'x')]


def test_figures_are_shares_and_milliseconds(calls):
    for number, name in enumerate('aab'):
        calls.ask(1.0, number)
        calls.answered(1.25, number, name, 'x')
    calls.died(2.0, 'c')
    rows = figures.rows('/plan', list(calls.replicas.values()))
    assert [row['share'] for row in rows] == pytest.approx([2 / 3, 1 / 3, 0])
    assert [row['state'] for row in rows] == ['live', 'live', 'died']
    assert rows[0]['latency'] == 250 and rows[2]['latency'] is None
    assert [row['failures'] for row in rows] == [0, 0, 1]


@settings(deadline=None, max_examples=300)
@given(st.integers(0, 2**32), st.sampled_from([None, 5.0, 40.0, 'p95']),
       st.floats(0, 0.3), st.floats(0, 0.3), st.sampled_from(['', 'c']))
def test_each_request_gets_one_answer(seed, after, lost, failing, last):
    """Replicas lose requests, fail, die and start again, but the last one answers."""
    rng = random.Random(seed)
    calls = ready(Calls(NAMES, after, last, 0.05))
    events, answers, order = [], {}, iter(range(10**9))

    def later(seconds, what, *rest):
        heapq.heappush(events, (now + seconds, next(order), what, *rest))

    def do(actions):
        for action in actions:
            if isinstance(action, Answer):
                assert action.call not in answers
                answers[action.call] = action.response
            elif action.replica == 'c' or rng.random() > lost:
                later(rng.expovariate(100), 'answer', action.call, action.replica)

    now = 0.0
    for number in range(60):
        later(0.01 * number, 'ask', number)
    for _ in range(6):
        later(rng.random(), rng.choice(('died', 'started', 'gone', 'back')), rng.choice('ab'))
    steps = 0
    while events or calls.next_due() < 1e6:
        steps += 1
        assert steps < 5000
        if not events or calls.next_due() < events[0][0]:
            now = max(now, calls.next_due())
            do(calls.due(now))
            continue
        now, _, what, *rest = heapq.heappop(events)
        if what == 'ask':
            do(calls.ask(now, *rest))
        elif what == 'answer':
            call, name = rest
            failed = name != 'c' and rng.random() < failing
            do(calls.answered(now, call, name, 'no' if failed else 'yes', failed=failed))
        elif what == 'died':
            do(calls.died(now, *rest))
        elif what == 'started':
            calls.started(*rest)
        else:
            do(calls.ready(now, NAMES if what == 'back' else set(NAMES) - {*rest}))
    # requests may be lost by all but the last replica, which is asked in the end
    assert set(answers.values()) == {'yes'} and len(answers) == 60


def test_figures_are_written_when_they_change(calls, tmp_path):
    public = SimpleNamespace(name='/plan', figures=calls)
    node = SimpleNamespace(
        lock=nullcontext(), _public=[public], _path=tmp_path / 'figures', _written='')
    file = tmp_path / 'figures.json'
    FirstAnswer._write(node)
    first = file.stat().st_ino
    assert '"machine": "a"' in file.read_text()
    FirstAnswer._write(node)
    assert file.stat().st_ino == first
    calls.died(1.0, 'a')
    FirstAnswer._write(node)
    assert 'died' in file.read_text()


@pytest.mark.parametrize('after', [None, 40.0])
def test_requests_that_nobody_answers_do_not_add_up(after):
    calls, drops = ready(Calls(['a', 'b'], after)), []
    for call in range(3 * MOST):
        drops += [action for action in calls.ask(0.5 * call, call) if isinstance(action, Drop)]
        calls.due(0.5 * call)
    now = 0.5 * call
    assert drops == [Drop(old) for old in range(2 * MOST)]
    # an answer to a dropped request shows that the replica is back, and answers nobody
    assert calls.answered(now, call - MOST + 1, 'a', 'yes') == [Answer(call - MOST + 1, 'yes')]
    assert calls.answered(now, call - MOST, 'a', 'yes') == []
    for name in 'ab':
        calls.died(now, name)
    calls.started('a')
    assert len(calls.ready(now, []) + calls.ready(now, ['a'])) == MOST - 1


def test_replica_that_hangs_for_weeks_has_few_requests():
    calls = ready(Calls(['a', 'b']))
    for call in range(3 * MOST):
        now = call * PROBE
        sent = {action.replica for action in calls.ask(now, call)}
        assert 'a' in sent
        calls.answered(now, call, 'a', 'yes')
    hanging = calls.replicas['b']
    assert len(hanging.sent) == MOST and max(hanging.sent) == call and not hanging.live
