# SPDX-License-Identifier: Apache-2.0
"""The launch's own ROS node, made when something first needs it."""
from __future__ import annotations

import os
import threading
from typing import Any, List, Optional

from launch import LaunchContext
from launch.event_handlers import OnShutdown


class ROSAdapter:
    """
    A node that spins in a thread.

    :param argv: arguments for ``rclpy.init()``.
    :param autostart: whether to start at once.
    """

    def __init__(self, *, argv: Optional[List[str]] = None, autostart: bool = True) -> None:
        self.__argv = [] if argv is None else argv
        self.__ros_context: Any = None
        self.__ros_node: Any = None
        self.__ros_executor: Any = None
        self.__is_running = False
        if autostart:
            self.start()

    def start(self) -> None:
        """
        Make node and thread.

        :raises RuntimeError: if there are such already.
        """
        if self.__is_running:
            raise RuntimeError('Cannot start a ROS adapter that is already running')
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        self.__ros_context = rclpy.Context()
        rclpy.init(args=self.__argv, context=self.__ros_context)
        self.__ros_node = rclpy.create_node(
            f'launch_ros_{os.getpid()}', context=self.__ros_context)
        self.__ros_executor = SingleThreadedExecutor(context=self.__ros_context)
        self.__is_running = True
        self.__thread = threading.Thread(target=self._run, name='launch_ros')
        self.__thread.start()

    def _run(self) -> None:
        self.__ros_executor.add_node(self.__ros_node)
        try:
            while self.__is_running:
                self.__ros_executor.spin_once(timeout_sec=1.0)
        finally:
            self.__ros_executor.remove_node(self.__ros_node)

    def shutdown(self) -> None:
        """
        End thread and node.

        :raises RuntimeError: if there are none.
        """
        if not self.__is_running:
            raise RuntimeError('Cannot shutdown a ROS adapter that is not running')
        import rclpy
        self.__is_running = False
        # The thread may be waiting for its next second.
        self.__ros_executor.wake()
        self.__thread.join()
        self.__ros_node.destroy_node()
        rclpy.shutdown(context=self.__ros_context)

    @property
    def argv(self) -> List[str]:
        """The arguments for ``rclpy.init()``."""
        return self.__argv

    @property
    def ros_context(self) -> Any:
        """The rclpy context."""
        return self.__ros_context

    @property
    def ros_node(self) -> Any:
        """The rclpy node."""
        return self.__ros_node

    @property
    def ros_executor(self) -> Any:
        """The executor that the node spins in."""
        return self.__ros_executor


def get_ros_adapter(context: LaunchContext) -> ROSAdapter:
    """Return the launch's adapter, made at the first call; a shutdown ends it."""
    adapter: Optional[ROSAdapter] = context.get_locals_as_dict().get('ros_adapter')
    if adapter is None:
        adapter = ROSAdapter()
        running = adapter
        context.extend_globals({'ros_adapter': adapter})
        context.register_event_handler(
            OnShutdown(on_shutdown=lambda event, context: running.shutdown()))
    return adapter


def get_ros_node(context: LaunchContext) -> Any:
    """Return the launch's own node, made at the first call."""
    return get_ros_adapter(context).ros_node
