# SPDX-License-Identifier: Apache-2.0
"""Decide what follows for one machine of a launch, from its bring-up to its end or replacement."""

from __future__ import annotations

import dataclasses
from typing import Literal

#: ``awaited``: it does not run yet. ``ending``: its agent ends everything, and nobody knows yet
#: whether the machine is gone. ``reclaimed``: its provider takes it away, and it still runs.
#: ``drained``: so, and its nodes have ended. ``gone``: it does not run any more. ``replaced``:
#: another machine is up, and the nodes are not there yet. ``over``: the launch goes on without it.
Phase = Literal[
    'awaited', 'up', 'ending', 'reclaimed', 'drained', 'gone', 'replaced', 'over']
#: ``claim``: the machine says that it is reclaimed, which may be forged; ``refuted``: its provider
#: does not confirm that. ``last_words``: its agent ends everything. ``spared``: after these, the
#: machine is still there. ``empty``: none of its processes runs there. ``replaced``: another
#: machine is up; ``returned``: the nodes wait for it. ``given_up``: the launch
#: is to go on without it.
Event = Literal[
    'up', 'claim', 'refuted', 'last_words', 'spared', 'reclaimed', 'empty', 'gone', 'replaced',
    'returned', 'given_up']
#: ``confirm``: ask the provider about a claim. ``hold``: keep exits back, for ``spared`` or
#: ``gone`` to follow. ``release``: report them. ``announce``: the machine is reclaimed, or gone.
#: ``bury``: it is gone, after it was reclaimed. ``save``: take the last checkpoint.
Command = Literal['confirm', 'hold', 'release', 'announce', 'bury', 'save']


@dataclasses.dataclass(frozen=True)
class MachineState:
    """
    The state of a machine.

    :param survivable: whether its processes go on elsewhere without it.
    :param doubted: whether its provider is asked about a claim.
    """

    survivable: bool
    phase: Phase = 'awaited'
    doubted: bool = False

    @property
    def interrupted(self) -> bool:
        """Whether it is reclaimed or gone, and its processes are not on another machine yet."""
        return self.phase in ('reclaimed', 'drained', 'gone', 'replaced')


def decide(state: MachineState, event: Event) -> tuple[MachineState, tuple[Command, ...]]:
    """Return the next state and the commands of an event; one that is too late changes nothing."""
    phase, change = state.phase, dataclasses.replace
    running = phase in ('awaited', 'up', 'ending')
    if event == 'up' and phase == 'awaited':
        return change(state, phase='up'), ()
    if event == 'claim' and running and not state.doubted:
        return change(state, doubted=True), ('confirm',)
    if event == 'refuted':
        return change(state, doubted=False), ()
    if event == 'last_words' and phase in ('awaited', 'up') and state.survivable:
        return change(state, phase='ending'), ('hold',)
    if event == 'spared' and phase == 'ending':
        return change(state, phase='up'), ('release',)
    if event in ('reclaimed', 'gone') and running:
        return change(state, phase=event), ('announce',)
    if event == 'gone' and state.interrupted:
        return change(state, phase='gone'), ('bury',)
    if event == 'empty' and phase == 'reclaimed':
        return change(state, phase='drained'), ('save',)
    if event == 'replaced' and state.interrupted:
        return change(state, phase='replaced'), ()
    if event == 'returned' and phase == 'replaced':
        return change(state, phase='up'), ()
    if event == 'given_up' and phase in ('up', 'ending'):
        return change(state, phase='over'), ()
    return state, ()
