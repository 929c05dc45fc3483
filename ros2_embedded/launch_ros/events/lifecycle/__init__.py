# SPDX-License-Identifier: Apache-2.0
"""Events of nodes with a lifecycle."""
from __future__ import annotations

from typing import Any, Callable

from launch import Event

from ..matchers import matches_node_name as matches_node_name

_TRANSITIONS = ('CREATE', 'CONFIGURE', 'CLEANUP', 'ACTIVATE', 'DEACTIVATE',
                'UNCONFIGURED_SHUTDOWN', 'INACTIVE_SHUTDOWN', 'ACTIVE_SHUTDOWN', 'DESTROY')


class ChangeState(Event):
    """
    Nodes whose actions match shall make a transition, a number of lifecycle_msgs' Transition.

    :raises ValueError: for any other number.
    """

    # As in lifecycle_msgs, which is only needed where nodes have a lifecycle.
    valid_transitions = {number: f'TRANSITION_{name}' for number, name in enumerate(_TRANSITIONS)}

    def __init__(
        self, *, lifecycle_node_matcher: Callable[[Any], bool], transition_id: int
    ) -> None:
        if transition_id not in self.valid_transitions:
            valid = ', '.join(f'{name}: {key}' for key, name in self.valid_transitions.items())
            raise ValueError(
                f"given transition_id of '{transition_id}', expected one of {{{valid}}}")
        self.lifecycle_node_matcher = lifecycle_node_matcher
        self.transition_id = transition_id


class StateTransition(Event):
    """A node made a transition: ``msg`` is its ``lifecycle_msgs.msg.TransitionEvent``."""

    def __init__(self, *, action: Any, msg: Any) -> None:
        self.action = action
        self.msg = msg
        self.timestamp: int = msg.timestamp
        self.transition: str = msg.transition.label
        self.start_state: str = msg.start_state.label
        self.goal_state: str = msg.goal_state.label
