# SPDX-License-Identifier: Apache-2.0
"""What follows for a machine of a launch, by value."""

from __future__ import annotations

import itertools
from typing import get_args

import pytest

from fogros2_features.replacement.machine_state import Command, decide, Event, MachineState, Phase


def after(*events: Event, survivable: bool = True) -> tuple[MachineState, list[Command]]:
    """Return the state after events, and the commands on the way."""
    state, said = MachineState(survivable), []
    for event in events:
        state, commands = decide(state, event)
        said += commands
    return state, said


@pytest.mark.parametrize('events, phase, commands', [
    ('up', 'up', ''),
    ('up given_up gone last_words', 'over', ''),
    # a machine's word alone changes nothing
    ('up claim claim refuted', 'up', 'confirm'),
    ('up claim refuted claim', 'up', 'confirm confirm'),
    ('up claim reclaimed refuted', 'reclaimed', 'confirm announce'),
    ('up last_words spared', 'up', 'hold release'),
    ('up last_words gone spared', 'gone', 'hold announce'),
    ('up last_words last_words reclaimed spared', 'reclaimed', 'hold announce'),
    ('up reclaimed reclaimed', 'reclaimed', 'announce'),
    ('up reclaimed empty empty', 'drained', 'announce save'),
    ('up reclaimed empty gone empty', 'gone', 'announce save bury'),
    ('up gone empty', 'gone', 'announce'),
    # of its replacement, no process has started yet
    ('up gone replaced empty', 'replaced', 'announce'),
    ('up reclaimed empty replaced returned', 'up', 'announce save'),
    ('up gone replaced gone', 'gone', 'announce bury'),
    ('up gone replaced returned reclaimed', 'reclaimed', 'announce announce'),
    ('up gone given_up', 'gone', 'announce')])
def test_machine_goes_from_state_to_state(events: str, phase: str, commands: str) -> None:
    state, said = after(*events.split())  # type: ignore[arg-type]
    assert (state.phase, ' '.join(said)) == (phase, commands)


def test_exits_are_held_only_where_processes_survive() -> None:
    assert after('up', 'last_words', survivable=False) == (
        MachineState(False, 'up'), [])


def test_interruption_is_announced_once_for_each_machine() -> None:
    for events in itertools.product(get_args(Event), repeat=4):
        state, said = after('up', *events)
        assert state.phase in get_args(Phase)
        returns = sum(event == 'returned' for event in events)
        assert said.count('announce') <= 1 + returns, events
        assert not state.interrupted or 'announce' in said, events
