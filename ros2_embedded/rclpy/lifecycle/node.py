# SPDX-License-Identifier: Apache-2.0
"""Managed nodes: the states and transitions of ROS 2's node lifecycle design."""

from collections.abc import Container
from functools import partialmethod
from typing import Any, NamedTuple

from lifecycle_msgs import msg, srv
from lifecycle_msgs.msg import State, Transition
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import RCLError
from rclpy.lifecycle.managed_entity import ManagedEntity, TransitionCallbackReturn
from rclpy.lifecycle.publisher import LifecyclePublisher
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.publisher import Publisher

_UNCONFIGURED, _INACTIVE, _ACTIVE, _FINALIZED = 1, 2, 3, 4
_ERROR = State.TRANSITION_STATE_ERRORPROCESSING
_STATES = {0: 'unknown', _UNCONFIGURED: 'unconfigured', _INACTIVE: 'inactive', _ACTIVE: 'active',
           _FINALIZED: 'finalized', 10: 'configuring', 11: 'cleaningup', 12: 'shuttingdown',
           13: 'activating', 14: 'deactivating', _ERROR: 'errorprocessing'}
_CALLBACKS = {10: 'on_configure', 11: 'on_cleanup', 12: 'on_shutdown', 13: 'on_activate',
              14: 'on_deactivate', _ERROR: 'on_error'}


def _transitions() -> list[tuple[int, str, int, int]]:
    """List the transitions: id, label, start and goal."""
    found = [
        (Transition.TRANSITION_CONFIGURE, 'configure', _UNCONFIGURED, 10),
        (Transition.TRANSITION_CLEANUP, 'cleanup', _INACTIVE, 11),
        (Transition.TRANSITION_ACTIVATE, 'activate', _INACTIVE, 13),
        (Transition.TRANSITION_DEACTIVATE, 'deactivate', _ACTIVE, 14),
        (Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, 'shutdown', _UNCONFIGURED, 12),
        (Transition.TRANSITION_INACTIVE_SHUTDOWN, 'shutdown', _INACTIVE, 12),
        (Transition.TRANSITION_ACTIVE_SHUTDOWN, 'shutdown', _ACTIVE, 12)]
    # where success, failure and error of each lead to
    for first, start, goals in (
            (10, 10, (_INACTIVE, _UNCONFIGURED, _ERROR)),
            (20, 11, (_UNCONFIGURED, _INACTIVE, _ERROR)),
            (30, 13, (_ACTIVE, _INACTIVE, _ERROR)),
            (40, 14, (_INACTIVE, _ACTIVE, _ERROR)),
            (50, 12, (_FINALIZED, _FINALIZED, _ERROR)),
            (60, _ERROR, (_UNCONFIGURED, _FINALIZED, _FINALIZED))):
        for offset, goal in enumerate(goals):
            label = f'transition_{("success", "failure", "error")[offset]}'
            found.append((first + offset, label, start, goal))
    return found


_TRANSITIONS = _transitions()


class LifecycleState(NamedTuple):
    """A state."""

    label: str
    state_id: int


class LifecycleNodeMixin(ManagedEntity):
    """The managed part of a node; a class that has it is a :class:`.Node`, too."""

    _state: int

    def __init__(self, *, enable_communication_interface: bool = True,
                 callback_group: CallbackGroup | None = None) -> None:
        assert isinstance(self, Node)
        self._state = _UNCONFIGURED
        self._managed_entities: set[ManagedEntity] = set()
        self._transition_events: Publisher | None = None
        if not enable_communication_interface:
            return
        self._transition_events = self.create_publisher(
            msg.TransitionEvent, '~/transition_event', 10)
        for kind, name, callback in (
                (srv.ChangeState, 'change_state', self._on_change_state),
                (srv.GetState, 'get_state', self._on_get_state),
                (srv.GetAvailableStates, 'get_available_states', self._on_states),
                (srv.GetAvailableTransitions, 'get_available_transitions', self._on_available),
                (srv.GetAvailableTransitions, 'get_transition_graph', self._on_graph)):
            self.create_service(kind, f'~/{name}', callback, callback_group=callback_group)

    # --- transitions ---

    def _enter(self, transition: int) -> None:
        for number, label, start, goal in _TRANSITIONS:
            if (number, start) == (transition, self._state):
                self._state = goal
                if self._transition_events is not None:
                    event = msg.TransitionEvent(
                        transition=Transition(id=number, label=label), start_state=_message(start),
                        goal_state=_message(goal))
                    self._transition_events.publish(event)
                return
        raise RCLError(f"Failed to trigger lifecycle state machine transition: transition "
                       f"{transition} is not possible in state '{_STATES[self._state]}'")

    def _leave(self, before: LifecycleState) -> TransitionCallbackReturn:
        """Call the callback of a transition's state and go where it leads."""
        callback = getattr(self, _CALLBACKS[self._state])
        try:
            result = callback(before)
        except Exception as error:  # noqa: BLE001 - the node's own code; on_error decides
            get_logger('lifecycle').error(f'Caught exception in transition: {error!r}')
            result = TransitionCallbackReturn.ERROR
        if not isinstance(result, TransitionCallbackReturn):
            result = TransitionCallbackReturn.ERROR
        wanted = f'transition_{result.name.lower()}'
        self._enter(next(number for number, label, start, _ in _TRANSITIONS
                         if (label, start) == (wanted, self._state)))
        return result

    def _change(self, transition: int) -> TransitionCallbackReturn:
        before = LifecycleState(_STATES[self._state], self._state)
        self._enter(transition)
        result = self._leave(before)
        if self._state == _ERROR:
            self._leave(before)
        return result

    trigger_configure = partialmethod(_change, Transition.TRANSITION_CONFIGURE)
    trigger_cleanup = partialmethod(_change, Transition.TRANSITION_CLEANUP)
    trigger_activate = partialmethod(_change, Transition.TRANSITION_ACTIVATE)
    trigger_deactivate = partialmethod(_change, Transition.TRANSITION_DEACTIVATE)

    def trigger_shutdown(self) -> TransitionCallbackReturn:
        """
        Shut the node down.

        :raises RCLError: if that is impossible in its state.
        """
        for number, label, start, _ in _TRANSITIONS:
            if (label, start) == ('shutdown', self._state):
                return self._change(number)
        raise RCLError('Shutdown transtion not possible')

    # --- entities ---

    def add_managed_entity(self, entity: ManagedEntity) -> None:
        """Have an entity take part in transitions."""
        if not isinstance(entity, ManagedEntity):
            raise TypeError('Expected a rclpy.lifecycle.ManagedEntity instance.')
        self._managed_entities.add(entity)

    def _all_entities(self, callback: str, state: LifecycleState) -> TransitionCallbackReturn:
        for entity in self._managed_entities:
            result = getattr(entity, callback)(state)
            if not isinstance(result, TransitionCallbackReturn):
                raise TypeError(f'{callback}() return value of class {type(entity)} should be'
                                ' `TransitionCallbackReturn`.\nInstance of the class that caused '
                                f'the failure: {entity}')
            if result is not TransitionCallbackReturn.SUCCESS:
                return result
        return TransitionCallbackReturn.SUCCESS

    # a node that overrides one of these calls it to have its entities take part
    on_configure = partialmethod(_all_entities, 'on_configure')
    on_cleanup = partialmethod(_all_entities, 'on_cleanup')
    on_shutdown = partialmethod(_all_entities, 'on_shutdown')
    on_activate = partialmethod(_all_entities, 'on_activate')
    on_deactivate = partialmethod(_all_entities, 'on_deactivate')
    on_error = partialmethod(_all_entities, 'on_error')

    def create_lifecycle_publisher(self, *args: Any, **kwargs: Any) -> LifecyclePublisher:
        """Create a publisher that publishes while the node is active."""
        assert isinstance(self, Node)
        if 'publisher_class' in kwargs:
            raise TypeError(
                "create_publisher() got an unexpected keyword argument 'publisher_class'")
        publisher = self.create_publisher(*args, **kwargs, publisher_class=LifecyclePublisher)
        assert isinstance(publisher, LifecyclePublisher)
        self._managed_entities.add(publisher)
        return publisher

    def destroy_lifecycle_publisher(self, publisher: LifecyclePublisher) -> bool:
        """Destroy such a publisher."""
        assert isinstance(self, Node)
        self._managed_entities.discard(publisher)
        return self.destroy_publisher(publisher)

    # --- services ---

    def _on_change_state(self, request: Any, response: Any) -> Any:
        wanted = request.transition.id
        if request.transition.label:
            fits = [number for number, label, start, _ in _TRANSITIONS
                    if (label, start) == (request.transition.label, self._state)]
            if not fits:
                return response
            wanted = fits[0]
        try:
            response.success = self._change(wanted) is TransitionCallbackReturn.SUCCESS
        except RCLError as error:
            get_logger('lifecycle').error(str(error))
        return response

    def _on_get_state(self, request: Any, response: Any) -> Any:
        response.current_state = _message(self._state)
        return response

    def _on_states(self, request: Any, response: Any) -> Any:
        response.available_states = [_message(number) for number in _STATES]
        return response

    def _on_available(self, request: Any, response: Any) -> Any:
        return self._describe(response, {self._state})

    def _on_graph(self, request: Any, response: Any) -> Any:
        return self._describe(response, _STATES)

    @staticmethod
    def _describe(response: Any, states: Container[int]) -> Any:
        response.available_transitions = [
            msg.TransitionDescription(transition=Transition(id=number, label=label),
                                      start_state=_message(start), goal_state=_message(goal))
            for number, label, start, goal in _TRANSITIONS if start in states]
        return response


def _message(state: int) -> Any:
    return State(id=state, label=_STATES[state])


class LifecycleNode(LifecycleNodeMixin, Node):
    """
    A managed node.

    :param enable_communication_interface: whether others may ask for transitions.
    """

    def __init__(self, node_name: str, *, enable_communication_interface: bool = True,
                 **kwargs: Any) -> None:
        Node.__init__(self, node_name, **kwargs)
        LifecycleNodeMixin.__init__(
            self, enable_communication_interface=enable_communication_interface)
