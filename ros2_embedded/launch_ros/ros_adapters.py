# SPDX-License-Identifier: Apache-2.0
"""The launch's own ROS node, made when something first needs it."""
from __future__ import annotations

import logging
import os
import threading
from typing import Any, List, Optional

from launch import LaunchContext, LaunchDescriptionEntity
from launch.event_handlers import OnShutdown


class ROSAdapter:
    """A node that spins in a thread."""

    def __init__(self, *, argv: Optional[List[str]] = None, autostart: bool = True) -> None:
        self.argv = [] if argv is None else argv
        self.ros_context: Any = None
        self.ros_node: Any = None
        self.ros_executor: Any = None
        self.__is_running = False
        if autostart:
            self.start()

    def start(self) -> None:
        if self.__is_running:
            raise RuntimeError('Cannot start a ROS adapter that is already running')
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        self.ros_context = Context()
        rclpy.init(args=self.argv, context=self.ros_context)
        self.ros_node = rclpy.create_node(
            f'launch_ros_{os.getpid()}', context=self.ros_context)
        self.ros_executor = SingleThreadedExecutor(context=self.ros_context)
        self.__is_running = True
        self.__thread = threading.Thread(target=self._run, name='launch_ros')
        self.__thread.start()

    def _run(self) -> None:
        self.ros_executor.add_node(self.ros_node)
        try:
            while self.__is_running:
                self.ros_executor.spin_once(timeout_sec=1.0)
        finally:
            self.ros_executor.remove_node(self.ros_node)

    def shutdown(self) -> None:
        if not self.__is_running:
            raise RuntimeError('Cannot shutdown a ROS adapter that is not running')
        import rclpy
        self.__is_running = False
        # The thread may be waiting for its next second.
        self.ros_executor.wake()
        self.__thread.join()
        self.ros_node.destroy_node()
        rclpy.shutdown(context=self.ros_context)


def get_ros_adapter(context: LaunchContext) -> ROSAdapter:
    """Return the launch's adapter, made at the first call; a shutdown ends it."""
    adapter: Optional[ROSAdapter] = context.get_locals_as_dict().get('ros_adapter')
    if adapter is None:
        made = adapter = ROSAdapter()
        context.extend_globals({'ros_adapter': made})

        def on_shutdown(event: Any, context: LaunchContext) -> List[LaunchDescriptionEntity]:
            made.shutdown()
            return []

        context.register_event_handler(OnShutdown(on_shutdown=on_shutdown))
    return adapter


def get_ros_node(context: LaunchContext) -> Any:
    return get_ros_adapter(context).ros_node


def call_service(
    client: Any, request: Any, context: LaunchContext, logger: logging.Logger
) -> Optional[Any]:
    """
    Wait for the service and return its response; None when the launch shuts down meanwhile.

    Blocks: call it in an executor's thread.
    """
    while not client.wait_for_service(timeout_sec=1.0):
        if context.is_shutdown:
            logger.warning(
                f"Abandoning wait for the '{client.srv_name}' service, due to shutdown.")
            return None
    answered = threading.Event()
    future = client.call_async(request)
    future.add_done_callback(lambda _: answered.set())
    while not answered.wait(1.0):
        if context.is_shutdown:
            logger.warning(
                f"Abandoning wait for the '{client.srv_name}' service response, "
                'due to shutdown.')
            future.cancel()
            return None
    if future.exception() is not None:
        raise future.exception()
    return future.result()
