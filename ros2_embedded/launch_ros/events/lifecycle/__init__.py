# SPDX-License-Identifier: Apache-2.0
"""Events of nodes with a lifecycle."""
from __future__ import annotations

from typing import Any, Callable
import warnings

from launch import Event
from launch._aliases import alias_submodules

from ..matchers import matches_node_name as _matches_node_name

__all__ = ['ChangeState', 'matches_node_name', 'StateTransition']


def _numbered(prefix: str, *names: str) -> dict[int, str]:
    return {number: f'{prefix}_{name}' for number, name in enumerate(names)}


class ChangeState(Event):
    """
    Nodes whose actions match shall make a transition, a number of lifecycle_msgs' Transition.

    :raises ValueError: for any other number.
    """

    name = 'launch_ros.events.lifecycle.ChangeState'

    # As in lifecycle_msgs, which is only needed where nodes have a lifecycle.
    valid_transitions = _numbered(
        'TRANSITION', 'CREATE', 'CONFIGURE', 'CLEANUP', 'ACTIVATE', 'DEACTIVATE',
        'UNCONFIGURED_SHUTDOWN', 'INACTIVE_SHUTDOWN', 'ACTIVE_SHUTDOWN', 'DESTROY')
    valid_states = {
        **_numbered('PRIMARY_STATE', 'UNKNOWN', 'UNCONFIGURED', 'INACTIVE', 'ACTIVE', 'FINALIZED'),
        **{10 + number: name for number, name in _numbered(
            'TRANSITION_STATE', 'CONFIGURING', 'CLEANINGUP', 'SHUTTINGDOWN', 'ACTIVATING',
            'DEACTIVATING', 'ERRORPROCESSING').items()}}

    def __init__(
        self, *, lifecycle_node_matcher: Callable[[Any], bool], transition_id: int
    ) -> None:
        super().__init__()
        if transition_id not in self.valid_transitions:
            valid = ', '.join(f'{name}: {key}' for key, name in self.valid_transitions.items())
            raise ValueError(
                f"given transition_id of '{transition_id}', expected one of {{{valid}}}")
        self.lifecycle_node_matcher = lifecycle_node_matcher
        self.transition_id = transition_id


class StateTransition(Event):
    """A node made a transition: ``msg`` is its ``lifecycle_msgs.msg.TransitionEvent``."""

    name = 'launch_ros.events.lifecycle.StateTransition'

    def __init__(self, *, action: Any, msg: Any) -> None:
        super().__init__()
        self.action = action
        self.msg = msg
        self.timestamp: int = msg.timestamp
        self.transition: str = msg.transition.label
        self.start_state: str = msg.start_state.label
        self.goal_state: str = msg.goal_state.label


def matches_node_name(node_name: str) -> Callable[[Any], bool]:
    warnings.warn(
        "'matches_node_name' has been moved into the 'launch.events' module and will be removed "
        "from the 'lifecycle' module in the future", stacklevel=2)
    return _matches_node_name(node_name)


alias_submodules(
    __name__, ('ChangeState', 'StateTransition'),
    lifecycle_node_matchers=('matches_node_name',))
