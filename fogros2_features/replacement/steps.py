# SPDX-License-Identifier: Apache-2.0
"""
Decide the steps by which a new machine replaces one that is reclaimed, gone or silent.

Fencing: the command ``move``, after which nodes start elsewhere, follows only one of three events.
The agent has confirmed the end of all nodes, the provider has confirmed the end of the machine, or
the machine's own watchdog has stopped the nodes because the robot's heartbeats have ended.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, Optional

#: ``notice``: the provider reclaims the machine, which still runs. ``lost``: it is silent, or the
#: provider has ended it. ``drained``: its agent has confirmed that all nodes have ended.
#: ``ended``: the provider has deleted the machine; ``unended``: the provider did not answer.
#: ``created`` and ``refused``: the result of a creation. ``time``: a deadline may have passed.
Event = Literal['notice', 'lost', 'drained', 'ended', 'unended', 'created', 'refused', 'time']
#: ``drain``: stop the nodes by the agent. ``end``: stop the heartbeats and delete the machine.
#: ``move``: the nodes may start elsewhere. ``create``: create the machine again. ``come_back``:
#: the nodes move to it. ``retry``: ``end`` again after a pause. ``give_up``: create no more.
Command = Literal['drain', 'end', 'move', 'create', 'come_back', 'retry', 'give_up']

#: Seconds until the provider is asked again, at first.
RETRY = 10.0


@dataclasses.dataclass(frozen=True)
class Replacement:
    """
    The state of one machine of a launch, over all its replacements.

    :param limit: number of creations; a failed one counts.
    :param drain: seconds that the agent has to confirm the end of all nodes.
    :param fence: seconds from the last heartbeat until the nodes of any machine have ended.
    :param moved: whether the nodes may run elsewhere.
    :param deadline: time of the next ``time`` event.
    :param refused: number of creations that failed since the last one that did not.
    """

    limit: int
    drain: float
    fence: float
    phase: Literal['up', 'draining', 'ending', 'creating', 'over'] = 'up'
    moved: bool = False
    deadline: Optional[float] = None
    created: int = 0
    refused: int = 0

    @property
    def pause(self) -> float:
        """Seconds until the provider is asked again; it may lack capacity for minutes."""
        return RETRY * (1 if self.created >= self.limit else min(6 ** self.refused, 60))


def decide(
    state: Replacement, event: Event, now: float,
) -> tuple[Replacement, tuple[Command, ...]]:
    """
    Return the next state and the commands of an event; an event that is too late changes nothing.

    :param now: seconds of a monotonic clock.
    """
    change = dataclasses.replace
    phase = state.phase
    passed = event == 'time' and state.deadline is not None and now >= state.deadline
    if phase == 'up' and event == 'notice':
        return change(state, phase='draining', deadline=now + state.drain), ('drain',)
    if phase == 'draining' and event == 'drained':
        return change(state, phase='ending', moved=True, deadline=None), ('move', 'end')
    if phase in ('up', 'draining') and event == 'lost' or phase == 'draining' and passed:
        return change(state, phase='ending', deadline=now + state.fence), ('end',)
    if phase == 'ending' and passed:
        return change(state, moved=True, deadline=None), ('move',)
    if phase == 'ending' and event == 'unended':
        return state, ('retry',)
    if phase == 'ending' and event == 'ended':
        move: tuple[Command, ...] = () if state.moved else ('move',)
        state = change(state, moved=True, deadline=None)
        if state.created >= state.limit:
            return change(state, phase='over'), (*move, 'give_up')
        return change(state, phase='creating', created=state.created + 1), (*move, 'create')
    if phase == 'creating' and event == 'refused':
        return change(state, phase='ending', refused=state.refused + 1), ('retry',)
    if phase == 'creating' and event == 'created':
        return change(state, phase='up', moved=False, refused=0), ('come_back',)
    return state, ()
