# SPDX-License-Identifier: Apache-2.0
"""A node of this process."""
from __future__ import annotations

import os
import time
from typing import Any

from ros2cli.node import NODE_NAME_PREFIX

#: Seconds after which a graph that does not change counts as complete.
STILL = 0.7
#: Seconds after which the graph is used as it is. Fast DDS takes up to 2.7 s to find a node.
LONGEST = 3.0


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
        self._discover(getattr(args, 'spin_time', None))

    def _discover(self, seconds: float | None) -> None:
        """Spin for some seconds; with None, until the graph has others and is still."""
        import rclpy
        alone = self._graph()
        seen, begin = alone, time.monotonic()
        changed = begin
        while (now := time.monotonic()) - begin < (LONGEST if seconds is None else seconds):
            if seconds is None and seen != alone and now - changed > STILL:
                return
            rclpy.spin_once(self.node, timeout_sec=0.05)
            if (graph := self._graph()) != seen:
                seen, changed = graph, time.monotonic()

    def _graph(self) -> tuple[Any, ...]:
        return (sorted(self.node.get_node_names_and_namespaces()),
                self.node.get_topic_names_and_types(), self.node.get_service_names_and_types())

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
    parser.add_argument('--spin-time', type=float, default=None,
                        help='Spin time in seconds to wait for discovery '
                             f'(default: until nothing changes, at most {LONGEST:g})')
    parser.add_argument(
        '-s', '--use-sim-time', action='store_true', help='Enable ROS simulation time')
