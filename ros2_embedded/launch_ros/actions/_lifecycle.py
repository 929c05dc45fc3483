# SPDX-License-Identifier: Apache-2.0
"""Nodes with a lifecycle, and their transitions."""
from __future__ import annotations

import functools
from typing import Any

from launch import EventHandler, LaunchContext, LaunchDescriptionEntity, SomeSubstitutionsType
from launch.actions import OpaqueFunction
from launch.frontend import expose_action
import launch.logging
from launch.utilities.type_utils import normalize_typed_substitution, perform_typed_substitution

from ..events.lifecycle import ChangeState, StateTransition
from ..ros_adapters import call_service, get_ros_node
from .node import Node

#: As in lifecycle_msgs: configure, activate.
_AUTOSTART = (1, 3)


@expose_action('lifecycle_node')
class LifecycleNode(Node):
    """
    Executes a node with a lifecycle; ChangeState events reach it, StateTransition events tell.

    :param autostart: whether to configure and activate the node as soon as it runs.
    :raises RuntimeError: when executed with a name that isn't fully specified.
    """

    _texts = {**Node._texts, 'name': 'name', 'namespace': 'namespace'}
    _typed = {**Node._typed, 'autostart': bool}

    def __init__(
        self, *, name: SomeSubstitutionsType, namespace: SomeSubstitutionsType,
        autostart: bool | SomeSubstitutionsType = False, **kwargs: Any
    ) -> None:
        super().__init__(name=name, namespace=namespace, **kwargs)
        self.node_autostart = normalize_typed_substitution(autostart, bool)
        self.__logger = launch.logging.get_logger(__name__)
        self.__rclpy_subscription: Any = None
        self.__rclpy_change_state_client: Any = None

    def _on_transition_event(self, context: LaunchContext, msg: Any) -> None:
        # Called in the ROS node's thread.
        event = StateTransition(action=self, msg=msg)
        loop = context.asyncio_loop
        if loop is not None:
            loop.call_soon_threadsafe(context.emit_event_sync, event)

    def _change_states(self, context: LaunchContext, *transitions: int) -> None:
        """Have the node make transitions, one after another, in an executor's thread."""
        import lifecycle_msgs.srv

        def change() -> None:
            for number in transitions:
                request = lifecycle_msgs.srv.ChangeState.Request()
                request.transition.id = number
                response = call_service(
                    self.__rclpy_change_state_client, request, context, self.__logger)
                if response is not None and response.success:
                    continue
                if response is not None:
                    self.__logger.error(
                        f"Failed to make transition '{ChangeState.valid_transitions[number]}' "
                        f"for LifecycleNode '{self.node_name}'")
                return

        context.add_completion_future(context.asyncio_loop.run_in_executor(None, change))

    def _on_change_state_event(self, context: LaunchContext) -> None:
        event = context.locals.event
        if event.lifecycle_node_matcher(self):
            self._change_states(context, event.transition_id)

    def execute(self, context: LaunchContext) -> list[LaunchDescriptionEntity] | None:
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
        if perform_typed_substitution(context, self.node_autostart, bool):
            # The responses say when each transition is over: an event of it may get lost.
            self._change_states(context, *_AUTOSTART)
        return super().execute(context)
