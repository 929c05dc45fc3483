# SPDX-License-Identifier: Apache-2.0
"""A node of this process."""
from __future__ import annotations

import os
from typing import Any

from ros2cli.node import NODE_NAME_PREFIX

DEFAULT_TIMEOUT = 0.5


class DirectNode:
    """
    A node that has had time to discover others; its attributes are the node's.

    :param node_name: by default a hidden one.
    """

    def __init__(self, args: Any, *, node_name: str | None = None) -> None:
        import rclpy
        from rclpy.parameter import Parameter
        rclpy.init(args=[])
        self.node = rclpy.create_node(
            node_name or f'{NODE_NAME_PREFIX}_{os.getpid()}', start_parameter_services=False,
            parameter_overrides=[
                Parameter('use_sim_time', value=getattr(args, 'use_sim_time', False))])
        over: list[bool] = []
        timer = self.node.create_timer(
            getattr(args, 'spin_time', DEFAULT_TIMEOUT), lambda: over.append(True))
        while not over:
            rclpy.spin_once(self.node)
        self.node.destroy_timer(timer)

    def __enter__(self) -> DirectNode:
        return self

    def __getattr__(self, name: str) -> Any:
        return getattr(self.node, name)

    def __exit__(self, *exception: object) -> None:
        import rclpy
        self.node.destroy_node()
        rclpy.try_shutdown()


def add_arguments(parser: Any) -> None:
    """Add the options of such a node."""
    parser.add_argument('--spin-time', type=float, default=DEFAULT_TIMEOUT,
                        help='Spin time in seconds to wait for discovery')
    parser.add_argument(
        '-s', '--use-sim-time', action='store_true', help='Enable ROS simulation time')
