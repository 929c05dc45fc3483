# SPDX-License-Identifier: Apache-2.0
"""What replaces a machine, by value: no node starts elsewhere while it may still run."""

from __future__ import annotations

import dataclasses
import itertools
import random
from types import SimpleNamespace

import pytest

from fogros2.model import MachineSpec, NodeSpec
from fogros2_features.replacement.options import Options
from fogros2_features.replacement.replacer import GRACE, Replacer
from fogros2_features.replacement.steps import decide, Replacement

UP = Replacement(limit=2, drain=20.0, fence=140.0)


def play(*events, state=UP):
    """Return the commands of each event, given as its name or (name, seconds)."""
    said = []
    for event in events:
        name, now = event if isinstance(event, tuple) else (event, 0.0)
        state, commands = decide(state, name, now)
        said.append(commands)
    return said, state


def test_notice_drains_before_nodes_move():
    said, state = play('notice', 'drained', 'ended', 'created')
    assert said == [('drain',), ('move', 'end'), ('create',), ('come_back',)]
    assert state == dataclasses.replace(UP, created=1)


def test_ended_machine_is_confirmed_before_nodes_move():
    said, _ = play('lost', 'ended', 'created')
    assert said == [('end',), ('move', 'create'), ('come_back',)]


def test_silent_machine_without_provider_is_fenced_by_time():
    said, state = play('lost', ('unended', 5.0), ('time', 139.9), ('time', 140.0), 'unended')
    assert said == [('end',), ('retry',), (), ('move',), ('retry',)]
    assert play('ended', state=state)[0] == [('create',)], 'its nodes have moved already'


def test_agent_that_confirms_no_end_is_fenced():
    said, state = play('notice', ('time', 19.9), ('time', 20.0), 'drained', ('time', 159.9))
    assert said == [('drain',), (), ('end',), (), ()] and not state.moved
    assert play(('time', 160.0), state=state)[0] == [('move',)]


def test_loss_during_the_notice_waits_for_the_provider():
    assert play('notice', 'lost', 'drained', 'ended')[0] == [
        ('drain',), ('end',), (), ('move', 'create')]


def test_refused_creation_is_tried_again_up_to_the_limit():
    said, state = play('lost', 'ended', 'refused', 'ended', 'refused', 'ended', 'lost')
    assert said == [('end',), ('move', 'create'), ('retry',), ('create',), ('retry',),
                    ('give_up',), ()]
    assert state.phase == 'over'


def test_pauses_after_refused_creations_grow():
    state, pauses = dataclasses.replace(UP, limit=5, phase='ending'), []
    for _ in range(5):
        _, state = play('ended', 'refused', state=state)
        pauses.append(state.pause)
    # it gives up without another pause
    assert pauses == [60.0, 360.0, 600.0, 600.0, 10.0]
    assert play('ended', 'created', state=dataclasses.replace(state, limit=9))[1].pause == 10.0


def test_third_loss_gives_up_after_two_replacements():
    once = ('lost', 'ended', 'created')
    said, _ = play(*once, *once, 'notice', 'drained', 'ended')
    assert said[-3:] == [('drain',), ('move', 'end'), ('give_up',)]


@pytest.mark.parametrize('event', ['drained', 'ended', 'unended', 'created', 'refused', 'time'])
def test_late_event_changes_nothing(event):
    assert decide(UP, event, 1e9) == (UP, ())


def test_nodes_never_move_unfenced():
    """In random histories, ``move`` follows the agent, the provider, or the watchdog's time."""
    dice = random.Random(21)
    events = ('notice', 'lost', 'drained', 'ended', 'unended', 'created', 'refused', 'time')
    for _ in range(3000):
        state, now, silent = UP, 0.0, None
        for event in itertools.islice(iter(lambda: dice.choice(events), None), 40):
            now += dice.choice([0.0, 1.0, 15.0, 60.0])
            before = state
            state, commands = decide(state, event, now)
            if 'end' in commands and silent is None:
                silent = now
            if 'move' in commands:
                assert not before.moved and (
                    event == 'ended' or event == 'drained' and before.phase == 'draining'
                    or event == 'time' and now - silent >= UP.fence)
            if 'create' in commands:
                assert event == 'ended' and state.moved
            if 'come_back' in commands:
                silent = None


def test_fence_outlasts_the_watchdog_and_the_slowest_node():
    """A machine without heartbeats stops its nodes after ``robot_timeout``, which take time."""
    session = SimpleNamespace(own=Options(max_replacements=2), checkpoints=None,
                              spec=MachineSpec('planner', 'aws', robot_timeout=120.0))
    replacer = Replacer(session, None, None, in_thread=None, is_over=lambda: False, logger=None)
    assert (replacer.state.drain, replacer.state.fence) == (GRACE, 120.0 + GRACE)
    for seconds in (40.0, 1.0):
        replacer.allow(NodeSpec(
            id='1', name='mapper', sigterm_timeout=seconds, sigkill_timeout=20.0))
        assert (replacer.state.drain, replacer.state.fence) == (60.0 + GRACE, 180.0 + GRACE)


def test_ending_launch_replaces_nothing():
    """It deletes no machine that it keeps, and creates none."""
    asked, over = [], []
    session = SimpleNamespace(own=Options(max_replacements=2), checkpoints=None,
                              spec=MachineSpec('planner', 'aws'), request=asked.append)
    loop = SimpleNamespace(time=lambda: 0.0, call_at=lambda *_: None)
    replacer = Replacer(
        session, None, loop, in_thread=None, is_over=lambda: bool(over), logger=None)
    over.append('the launch ends')
    replacer.on('lost')
    assert asked == [] and replacer.state.phase == 'up'
    over.clear()
    replacer.on('lost')
    assert len(asked) == 1 and replacer.state.phase == 'ending'
