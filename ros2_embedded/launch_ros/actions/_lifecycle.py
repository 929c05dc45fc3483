# SPDX-License-Identifier: Apache-2.0
"""Nodes with a lifecycle, and their transitions."""
from __future__ import annotations

import functools
from typing import Any

from launch import EventHandler, LaunchContext, LaunchDescriptionEntity, SomeSubstitutionsType
from launch.actions import OpaqueFunction
import launch.logging

from ..events.lifecycle import ChangeState, StateTransition
from ..ros_adapters import call_service, get_ros_node
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

    def _on_transition_event(self, context: LaunchContext, msg: Any) -> None:
        # Called in the ROS node's thread.
        event = StateTransition(action=self, msg=msg)
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
        event = context.locals.event
        if not event.lifecycle_node_matcher(self):
            return
        import lifecycle_msgs.srv
        request = lifecycle_msgs.srv.ChangeState.Request()
        request.transition.id = event.transition_id
        context.add_completion_future(context.asyncio_loop.run_in_executor(
            None, self._call_change_state, request, context))

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
        return super().execute(context)
