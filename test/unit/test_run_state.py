# SPDX-License-Identifier: Apache-2.0
"""What follows for a process of a machine, by value."""

from __future__ import annotations

import itertools
from typing import get_args

import pytest

from fogros2.runtime.run_state import Command, decide, Event, Phase, RunState


def after(*events: Event, movable: bool = True) -> tuple[RunState, list[Command]]:
    """Return the state after events, and the commands on the way."""
    state, said = RunState(movable), []
    for event in events:
        state, commands = decide(state, event)
        said += commands
    return state, said


@pytest.mark.parametrize('events, phase, commands', [
    ('started', 'running', 'report'),
    ('started exited', 'ended', 'report report end'),
    ('started respawns', 'respawning', 'report report'),
    ('started respawns started', 'running', 'report report report'),
    ('refused', 'ended', 'report end'),
    ('started stop', 'running', 'report ask expect'),
    ('started stop stop', 'running', 'report ask expect'),
    ('started stop exited', 'ended', 'report ask expect report end'),
    ('started stop respawns', 'ended', 'report ask expect report end'),
    ('started stop overdue', 'ended', 'report ask expect report end'),
    ('started overdue', 'running', 'report'),
    ('stop', 'ended', 'end'),
    ('sent stop absent', 'ended', 'ask expect end'),
    # the agent could not start it again
    ('sent started refused', 'ended', 'report report end'),
    # its machine gets to know it after the request to end it
    ('sent stop started', 'running', 'ask expect report ask'),
    ('started respawns stop', 'ended', 'report report ask end'),
    ('absent', 'ended', 'end'),
    # it moves to the robot
    ('started move exited free', 'here', 'report ask expect leave come'),
    ('started move overdue free', 'here', 'report ask expect leave come'),
    ('started move move', 'leaving', 'report ask expect'),
    ('started move_gone free', 'here', 'report leave come'),
    ('started move move_gone free', 'here', 'report ask expect leave come'),
    ('move free', 'here', 'leave come'),
    ('sent move absent free', 'here', 'ask expect leave come'),
    ('started respawns move free', 'here', 'report report ask leave come'),
    ('started stop move', 'running', 'report ask expect'),
    ('started stop move_gone', 'ended', 'report ask expect end'),
    # its agent has died, and starts it again
    ('sent started respawns back sent started', 'running', 'report report report'),
    ('started respawns back stop', 'ended', 'report report end'),
    # the launch ends while the process moves
    ('started move stop exited', 'ended', 'report ask expect ask expect report end'),
    ('started move exited stop', 'ended', 'report ask expect leave end'),
    ('started move exited free stop', 'here', 'report ask expect leave come'),
    # another machine continues it
    ('started halt exited', 'away', 'report ask leave'),
    ('started halt exited back', 'waiting', 'report ask leave'),
    ('started halt exited left free back', 'waiting', 'report ask leave leave come'),
    ('started stop halt', 'running', 'report ask expect'),
    ('started stop halt_gone', 'ended', 'report ask expect end')])
def test_process_goes_from_state_to_state(events: str, phase: str, commands: str) -> None:
    state, said = after(*events.split())  # type: ignore[arg-type]
    assert (state.phase, ' '.join(said)) == (phase, commands)


@pytest.mark.parametrize('events, phase, commands', [
    ('started move exited', 'ended', 'report ask expect report end'),
    ('started move_gone', 'ended', 'report end'),
    ('started halt exited free', 'away', 'report ask leave'),
    ('started halt exited free back started', 'running', 'report ask leave report'),
    ('halt_gone stop', 'ended', 'leave end'),
    ('move', 'ended', 'end')])
def test_process_that_cannot_run_on_the_robot(events: str, phase: str, commands: str) -> None:
    state, said = after(*events.split(), movable=False)  # type: ignore[arg-type]
    assert (state.phase, ' '.join(said)) == (phase, commands)


@pytest.mark.parametrize('movable', [True, False])
def test_process_starts_elsewhere_only_after_it_left(movable: bool) -> None:
    """Of all sequences of four events, none starts a process twice or ends it twice."""
    for events in itertools.product(get_args(Event), repeat=4):
        state, said = after(*events, movable=movable)
        assert state.phase in get_args(Phase)
        assert said.count('end') <= 1 and ('end' in said) == (state.phase == 'ended'), events
        if 'come' in said:
            assert 'leave' in said[:said.index('come')] and movable, events
        if state.phase == 'ended':
            assert decide(state, 'started') == (state, ())


@pytest.mark.parametrize('phase', get_args(Phase))
def test_end_of_a_launch_reaches_every_process(phase: Phase) -> None:
    """One stop, and the machine's silence, end it wherever its machine still has it."""
    state = RunState(True, phase)
    for event in ('stop', 'overdue'):
        state, _ = decide(state, event)  # type: ignore[arg-type]
    # what runs on the robot is launch's own process by then
    assert state.phase == ('here' if phase == 'here' else 'ended')
