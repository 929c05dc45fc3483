# SPDX-License-Identifier: Apache-2.0
"""Nodes with a lifecycle, and their transitions."""
from __future__ import annotations

import functools
from typing import Any, Callable, cast, Dict, Iterable, List, Optional, Union

from launch import Action, Event, EventHandler, LaunchContext, SomeSubstitutionsType
from launch.actions import EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.launch_description_entity import LaunchDescriptionEntity
import launch.logging
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

from ..events.lifecycle import ChangeState, StateTransition
from ..events.matchers import matches_node_name
from ..ros_adapters import get_ros_node
from ._services import call_service
from .node import Node


class LifecycleNode(Node):
    """
    Executes a node with a lifecycle; ChangeState events reach it, StateTransition events tell.

    :raises RuntimeError: when executed with a name that isn't fully specified.
    """

    def __init__(
        self, *, name: SomeSubstitutionsType, namespace: SomeSubstitutionsType, **kwargs: Any
    ) -> None:
        super().__init__(name=name, namespace=namespace, **kwargs)
        self.__logger = launch.logging.get_logger(__name__)
        self.__rclpy_subscription: Any = None
        self.__rclpy_change_state_client: Any = None
        self.__current_state = ChangeState.valid_states[0]

    def _on_transition_event(self, context: LaunchContext, msg: Any) -> None:
        # Called in the ROS node's thread.
        event = StateTransition(action=self, msg=msg)
        self.__current_state = ChangeState.valid_states.get(
            msg.goal_state.id, self.__current_state)
        loop = context.asyncio_loop
        if loop is not None:
            loop.call_soon_threadsafe(context.emit_event_sync, event)

    def _call_change_state(self, request: Any, context: LaunchContext) -> None:
        response = call_service(
            self.__rclpy_change_state_client, request, context, self.__logger)
        if response is not None and not response.success:
            transition = ChangeState.valid_transitions[request.transition.id]
            self.__logger.error(
                f"Failed to make transition '{transition}' for LifecycleNode "
                f"'{self.node_name}'")

    def _on_change_state_event(self, context: LaunchContext) -> None:
        event = cast(ChangeState, context.locals.event)
        if not event.lifecycle_node_matcher(self):
            return
        import lifecycle_msgs.srv
        request = lifecycle_msgs.srv.ChangeState.Request()
        request.transition.id = event.transition_id
        context.add_completion_future(context.asyncio_loop.run_in_executor(
            None, self._call_change_state, request, context))

    def execute(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        self._perform_substitutions(context)
        if self.UNSPECIFIED_NODE_NAME in self.node_name:
            raise RuntimeError('node_name unexpectedly incomplete for lifecycle node')
        import lifecycle_msgs.msg
        import lifecycle_msgs.srv
        node = get_ros_node(context)
        self.__rclpy_subscription = node.create_subscription(
            lifecycle_msgs.msg.TransitionEvent, f'{self.node_name}/transition_event',
            functools.partial(self._on_transition_event, context), 10)
        self.__rclpy_change_state_client = node.create_client(
            lifecycle_msgs.srv.ChangeState, f'{self.node_name}/change_state')
        context.register_event_handler(EventHandler(
            matcher=lambda event: isinstance(event, ChangeState),
            entities=[OpaqueFunction(function=self._on_change_state_event)]))
        return super().execute(context)


class LifecycleTransition(Action):
    """
    Takes nodes with a lifecycle through transitions, each when the one before is done.

    :raises ValueError: for no nodes or no transitions; when executed, for a transition that
        isn't a number.
    """

    transition_targets = {
        1: {'start_state': 'configuring', 'goal_state': 'inactive'},
        2: {'start_state': 'cleaningup', 'goal_state': 'unconfigured'},
        3: {'start_state': 'activating', 'goal_state': 'active'},
        4: {'start_state': 'deactivating', 'goal_state': 'inactive'},
        5: {'start_state': 'shuttingdown', 'goal_state': 'finalized'},
        6: {'start_state': 'shuttingdown', 'goal_state': 'finalized'},
        7: {'start_state': 'shuttingdown', 'goal_state': 'finalized'},
    }

    def __init__(
        self, *, lifecycle_node_names: Iterable[SomeSubstitutionsType],
        transition_ids: Iterable[Union[int, SomeSubstitutionsType]], **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.__transition_ids = [
            normalize_to_list_of_substitutions(str(one) if isinstance(one, int) else one)
            for one in transition_ids]
        self.__lifecycle_node_names = [
            normalize_to_list_of_substitutions(name) for name in lifecycle_node_names]
        if not self.__transition_ids:
            raise ValueError('No transition_ids provided.')
        if not self.__lifecycle_node_names:
            raise ValueError('No lifecycle_node_names provided.')
        self.__event_handlers: Dict[str, List[EventHandler]] = {}
        self.__logger = launch.logging.get_logger(__name__)

    def _remove_event_handlers(
        self, context: LaunchContext, node_name: str, reason: Optional[str] = None
    ) -> None:
        if reason is not None:
            self.__logger.info(f"Stopping transitions for {node_name} because '{reason}'")
        for handler in self.__event_handlers[node_name]:
            if handler in context._event_handlers:
                context.unregister_event_handler(handler)

    def execute(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        from ..event_handlers import OnStateTransition
        numbers: List[int] = []
        for substitutions in self.__transition_ids:
            text = perform_substitutions(context, substitutions)
            try:
                numbers.append(int(text))
            except ValueError as exc:
                raise ValueError(
                    f'expected integer for lifecycle transition, got {text}') from exc
        entities: List[LaunchDescriptionEntity] = []
        for substitutions in self.__lifecycle_node_names:
            node = perform_substitutions(context, substitutions)
            emits: List[LaunchDescriptionEntity] = [
                EmitEvent(event=ChangeState(
                    lifecycle_node_matcher=matches_node_name(node), transition_id=number))
                for number in numbers]
            remove = functools.partial(self._remove_event_handlers, node_name=node)
            handlers: List[EventHandler] = [
                OnStateTransition(
                    matcher=_transition_of(node, **self.transition_targets[number]),
                    entities=[following], handle_once=True)
                for number, following in zip(numbers, [
                    *emits[1:], OpaqueFunction(function=remove)])]
            entities += [RegisterEventHandler(handler) for handler in handlers]
            on_error = EventHandler(
                matcher=_transition_of(node, goal_state='errorprocessing'), handle_once=True,
                entities=[OpaqueFunction(function=functools.partial(
                    remove, reason='error occured during transitions'))])
            context.register_event_handler(on_error)
            self.__event_handlers[node] = [*handlers, on_error]
            entities.append(emits[0])
        return entities


def _transition_of(
    node: str, *, goal_state: str, start_state: Optional[str] = None
) -> Callable[[Event], bool]:
    matches = matches_node_name(node)
    return lambda event: (
        isinstance(event, StateTransition) and matches(event.action)
        and event.goal_state == goal_state
        and start_state in (None, event.start_state))
