# SPDX-License-Identifier: Apache-2.0
"""The launch's own ROS node, made when something first needs it."""
from __future__ import annotations

import logging
import os
import threading
from typing import Any

from launch import LaunchContext
from launch.event_handlers import OnShutdown


class ROSAdapter:
    """A node that spins in a thread."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        self.ros_context = Context()
        rclpy.init(args=[], context=self.ros_context)
        self.ros_node = rclpy.create_node(f'launch_ros_{os.getpid()}', context=self.ros_context)
        self.ros_executor = SingleThreadedExecutor(context=self.ros_context)
        self.ros_executor.add_node(self.ros_node)
        self.__thread = threading.Thread(target=self.ros_executor.spin, name='launch_ros')
        self.__thread.start()

    def shutdown(self) -> None:
        import rclpy
        if not self.ros_context.ok():
            return  # a launch may be shut down twice
        self.ros_executor.shutdown()
        self.__thread.join()
        self.ros_node.destroy_node()
        rclpy.shutdown(context=self.ros_context)


def get_ros_adapter(context: LaunchContext) -> ROSAdapter:
    """Return the launch's adapter, made at the first call; a shutdown ends it."""
    adapter: ROSAdapter | None = context.get_locals_as_dict().get('ros_adapter')
    if adapter is None:
        made = adapter = ROSAdapter()
        context.extend_globals({'ros_adapter': made})
        context.register_event_handler(OnShutdown(on_shutdown=lambda *_: made.shutdown()))
    return adapter


def get_ros_node(context: LaunchContext) -> Any:
    return get_ros_adapter(context).ros_node


def call_service(
    client: Any, request: Any, context: LaunchContext, logger: logging.Logger
) -> Any:
    """
    Wait for the service and return its response; None when the launch shuts down meanwhile.

    Blocks: call it in an executor's thread.
    """
    from rclpy._rclpy_pybind11 import InvalidHandle, RCLError

    def given_up(what: str = '') -> bool:
        if context.is_shutdown:
            logger.warning(
                f"Abandoning wait for the '{client.srv_name}' service{what}, due to shutdown.")
        return context.is_shutdown

    try:
        while not client.wait_for_service(timeout_sec=1.0):
            if given_up():
                return None
    except (InvalidHandle, RCLError):
        # The shutdown has taken the node away meanwhile.
        if given_up():
            return None
        raise
    answered = threading.Event()
    future = client.call_async(request)
    future.add_done_callback(lambda _: answered.set())
    while not answered.wait(1.0):
        if given_up(' response'):
            future.cancel()
            return None
    if future.exception() is not None:
        raise future.exception()
    return future.result()
