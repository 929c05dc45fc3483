# SPDX-License-Identifier: Apache-2.0
"""Events of nodes with a lifecycle."""
from __future__ import annotations

from typing import Any, Callable, TYPE_CHECKING
import warnings

from launch._aliases import alias_submodules
from launch.event import Event

from ..matchers import matches_node_name as _matches_node_name

if TYPE_CHECKING:
    from ...actions import LifecycleNode

__all__ = ['ChangeState', 'matches_node_name', 'StateTransition']


class ChangeState(Event):
    """
    Nodes whose actions match shall make a transition.

    :param transition_id: a constant of ``lifecycle_msgs.msg.Transition``.
    :raises ValueError: for any other number.
    """

    name = 'launch_ros.events.lifecycle.ChangeState'

    # As in lifecycle_msgs, which is only needed where nodes have a lifecycle.
    valid_transitions = {
        0: 'TRANSITION_CREATE',
        1: 'TRANSITION_CONFIGURE',
        2: 'TRANSITION_CLEANUP',
        3: 'TRANSITION_ACTIVATE',
        4: 'TRANSITION_DEACTIVATE',
        5: 'TRANSITION_UNCONFIGURED_SHUTDOWN',
        6: 'TRANSITION_INACTIVE_SHUTDOWN',
        7: 'TRANSITION_ACTIVE_SHUTDOWN',
        8: 'TRANSITION_DESTROY',
    }
    valid_states = {
        0: 'PRIMARY_STATE_UNKNOWN',
        1: 'PRIMARY_STATE_UNCONFIGURED',
        2: 'PRIMARY_STATE_INACTIVE',
        3: 'PRIMARY_STATE_ACTIVE',
        4: 'PRIMARY_STATE_FINALIZED',
        10: 'TRANSITION_STATE_CONFIGURING',
        11: 'TRANSITION_STATE_CLEANINGUP',
        12: 'TRANSITION_STATE_SHUTTINGDOWN',
        13: 'TRANSITION_STATE_ACTIVATING',
        14: 'TRANSITION_STATE_DEACTIVATING',
        15: 'TRANSITION_STATE_ERRORPROCESSING',
    }

    def __init__(
        self, *, lifecycle_node_matcher: Callable[[LifecycleNode], bool], transition_id: int
    ) -> None:
        super().__init__()
        if transition_id not in self.valid_transitions:
            valid = ', '.join(f'{name}: {key}' for key, name in self.valid_transitions.items())
            raise ValueError(
                f"given transition_id of '{transition_id}', expected one of {{{valid}}}")
        self.__lifecycle_node_matcher = lifecycle_node_matcher
        self.__transition_id = transition_id

    @property
    def lifecycle_node_matcher(self) -> Callable[[LifecycleNode], bool]:
        """Says of an action whether its node is meant."""
        return self.__lifecycle_node_matcher

    @property
    def transition_id(self) -> int:
        """The transition."""
        return self.__transition_id


class StateTransition(Event):
    """
    A node made a transition.

    :param msg: the node's ``lifecycle_msgs.msg.TransitionEvent``.
    """

    name = 'launch_ros.events.lifecycle.StateTransition'

    def __init__(self, *, action: LifecycleNode, msg: Any) -> None:
        super().__init__()
        self.__action = action
        self.__msg = msg

    @property
    def action(self) -> LifecycleNode:
        """The node's action."""
        return self.__action

    @property
    def msg(self) -> Any:
        """The node's message."""
        return self.__msg

    @property
    def timestamp(self) -> int:
        """When, in nanoseconds."""
        return int(self.__msg.timestamp)

    @property
    def transition(self) -> str:
        """The transition's label."""
        return str(self.__msg.transition.label)

    @property
    def start_state(self) -> str:
        """The label of the state before."""
        return str(self.__msg.start_state.label)

    @property
    def goal_state(self) -> str:
        """The label of the state now."""
        return str(self.__msg.goal_state.label)


def matches_node_name(node_name: str) -> Callable[[LifecycleNode], bool]:
    """Return a matcher, see :func:`launch_ros.events.matches_node_name`."""
    warnings.warn(
        "'matches_node_name' has been moved into the 'launch.events' module and will be removed "
        "from the 'lifecycle' module in the future", stacklevel=2)
    return _matches_node_name(node_name)


alias_submodules(__name__, ('ChangeState', 'StateTransition'), {
    'lifecycle_node_matchers': ('matches_node_name',)})
