# SPDX-License-Identifier: Apache-2.0
"""
Decide what follows for one process of a machine: from its request to its end, or to its move.

A process that leaves its machine starts elsewhere only after its machine has confirmed its end, or
is gone.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

#: ``waiting``: for its machine. ``sent``: to its machine, and not started. ``respawning``: exited,
#: and its machine starts it again. ``leaving``: its machine ends it, so that it can go on
#: elsewhere. ``away``: it has left its machine, and runs nowhere yet. ``here``: it runs on the
#: robot. ``ended``: launch knows the end.
Phase = Literal[
    'waiting', 'sent', 'running', 'respawning', 'leaving', 'away', 'here', 'ended']
#: ``sent``: to its machine. ``stop``: launch wants its end. ``move`` (to the robot) and ``halt``
#: (for another machine): the machine can end it; ``move_gone`` and ``halt_gone``: the machine is
#: gone. ``absent``: it does not run on its machine, or nothing will be heard of it. ``overdue``:
#: its end has not been reported in time. ``started``, ``exited``, ``respawns`` (exited, and starts
#: again), ``refused``: what the agent says. ``left``: its machine no longer runs it. ``free``: it
#: may start elsewhere. ``back``: it waits for its machine, or a new one. ``over``: it ends,
#: whatever becomes of its machine.
Event = Literal[
    'sent', 'stop', 'move', 'move_gone', 'halt', 'halt_gone', 'absent', 'overdue', 'started',
    'exited', 'respawns', 'refused', 'left', 'free', 'back', 'over']
#: ``ask``: let the machine end it. ``expect``: ``overdue`` follows if it does not. ``report``:
#: pass on to launch what the event says. ``leave``: note that it has left its machine. ``come``:
#: start it on the robot. ``end``: no more events follow.
Command = Literal['ask', 'expect', 'report', 'leave', 'come', 'end']


@dataclasses.dataclass(frozen=True)
class RunState:
    """
    The state of a process.

    :param movable: whether it can run on the robot; others, such as those of features, end there.
    :param stopping: whether launch wants its end.
    """

    movable: bool
    phase: Phase = 'waiting'
    stopping: bool = False

    @property
    def started(self) -> bool:
        """Whether its machine has started it."""
        return self.phase in ('running', 'respawning', 'leaving')

    @property
    def over(self) -> bool:
        """Whether its machine has nothing to do with it any more."""
        return self.phase in ('here', 'ended')


def decide(state: RunState, event: Event) -> tuple[RunState, tuple[Command, ...]]:
    """Return the next state and the commands of an event; one that is too late changes nothing."""
    if state.phase == 'ended':
        return state, ()
    if event == 'back':
        return dataclasses.replace(state, phase='waiting'), ()
    if state.phase == 'here':
        return state, ()
    if event == 'over':
        return dataclasses.replace(state, phase='ended'), ('end',)
    if state.phase == 'away':
        return _decide_away(state, event)
    if event in ('started', 'exited', 'respawns', 'refused'):
        return _decide_report(state, event)
    change, leaving = dataclasses.replace, state.phase == 'leaving'
    if event == 'sent' and state.phase == 'waiting':
        return change(state, phase='sent'), ()
    if state.phase in ('waiting', 'respawning') and event in ('stop', 'move', 'halt'):
        # it does not run
        ask: tuple[Command, ...] = ('ask',) if state.phase == 'respawning' else ()
        if event == 'stop' or event == 'move' and not state.movable:
            return change(state, phase='ended', stopping=True), (*ask, 'end')
        return change(state, phase='away'), (*ask, 'leave')
    ended: tuple[RunState, tuple[Command, ...]] = change(state, phase='ended'), ('end',)
    left: tuple[RunState, tuple[Command, ...]] = change(state, phase='away'), ('leave',)
    if event == 'stop' or event == 'move' and not state.movable:
        if state.stopping:
            return state, ()
        return change(state, stopping=True), ('ask', 'expect')
    if event == 'move_gone' and not state.movable:
        return ended
    if event in ('move', 'halt') and not (state.stopping or leaving):
        return change(state, phase='leaving'), ('ask', 'expect') if event == 'move' else ('ask',)
    if event == 'overdue':
        if state.stopping:
            return ended[0], ('report', 'end')
        return left if leaving else (state, ())
    if event in ('move_gone', 'halt_gone', 'absent'):
        return ended if state.stopping or event == 'absent' and not leaving else left
    return left if event == 'left' else (state, ())


def _decide_away(state: RunState, event: Event) -> tuple[RunState, tuple[Command, ...]]:
    if event == 'stop' or event == 'free' and state.stopping:
        return dataclasses.replace(state, phase='ended', stopping=True), ('end',)
    if event == 'free' and state.movable:
        return dataclasses.replace(state, phase='here'), ('come',)
    return state, ('leave',) if event in ('left', 'move_gone', 'halt_gone') else ()


def _decide_report(state: RunState, event: Event) -> tuple[RunState, tuple[Command, ...]]:
    """Decide what follows from what the agent says of a process that it has."""
    leaving = state.phase == 'leaving'
    if event == 'started':
        # it may have been told to end it before it knew it
        return dataclasses.replace(state, phase='leaving' if leaving else 'running'), (
            ('report', 'ask') if state.stopping else ('report',))
    if leaving and not state.stopping:
        return dataclasses.replace(state, phase='away'), ('leave',)
    if event == 'respawns' and not state.stopping:
        return dataclasses.replace(state, phase='respawning'), ('report',)
    # a process that would have respawned has reported its exit
    reported = event == 'exited' and state.phase == 'respawning'
    return dataclasses.replace(state, phase='ended'), ('end',) if reported else ('report', 'end')
