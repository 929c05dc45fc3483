# SPDX-License-Identifier: Apache-2.0
"""A node of this process."""

import argparse
import os
from types import TracebackType
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
        rclpy.init(args=getattr(args, 'argv', []))
        suffix = getattr(args, 'node_name_suffix', f'_{os.getpid()}')
        self.node = rclpy.create_node(
            node_name or NODE_NAME_PREFIX + suffix,
            start_parameter_services=getattr(args, 'start_parameter_services', False),
            parameter_overrides=[
                Parameter('use_sim_time', value=getattr(args, 'use_sim_time', False)),
                Parameter('start_type_description_service',
                          value=getattr(args, 'start_type_description_service', True))],
            automatically_declare_parameters_from_overrides=True)
        over: list[bool] = []
        timer = self.node.create_timer(
            getattr(args, 'spin_time', DEFAULT_TIMEOUT), lambda: over.append(True))
        while not over:
            rclpy.spin_once(self.node)
        self.node.destroy_timer(timer)

    def __enter__(self) -> 'DirectNode':
        return self

    def __getattr__(self, name: str) -> Any:
        import rclpy
        if not rclpy.ok():
            raise RuntimeError('!rclpy.ok()')
        return getattr(self.node, name)

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:
        import rclpy
        self.node.destroy_node()
        rclpy.try_shutdown()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of such a node."""
    parser.add_argument(
        '--spin-time', type=float, default=DEFAULT_TIMEOUT,
        help='Spin time in seconds to wait for discovery (only applies when '
             'not using an already running daemon)')
    parser.add_argument(
        '-s', '--use-sim-time', action='store_true', help='Enable ROS simulation time')
