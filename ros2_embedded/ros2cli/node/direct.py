# SPDX-License-Identifier: Apache-2.0
"""A node of this process."""
from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import time
from typing import Any

from ros2cli.node import NODE_NAME_PREFIX

#: Seconds after which a graph that does not change counts as complete. Fast DDS sends a lost
#: answer again after 1 s.
STILL = 1.2
#: Seconds after which the graph is used as it is. Fast DDS takes up to 2.7 s to find a node.
LONGEST = 3.0
#: Settings of Fast DDS where the user has none.
_PROFILES = Path(__file__).with_name('fastdds.xml')


class DirectNode:
    """
    A node that has had time to discover others; its attributes are the node's.

    :param node_name: by default a hidden one.
    :param enough: ends the discovery when it returns True for the node.
    """

    def __init__(self, args: Any, *, node_name: str | None = None,
                 enough: Callable[[Any], bool] | None = None) -> None:
        import rclpy
        os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(_PROFILES))
        rclpy.init(args=[])
        self.node = rclpy.create_node(
            node_name or f'{NODE_NAME_PREFIX}_{os.getpid()}', start_parameter_services=False)
        self._discover(getattr(args, 'spin_time', None), enough)

    def _discover(self, seconds: float | None, enough: Callable[[Any], bool] | None) -> None:
        """Spin for some seconds; with None, until there is enough, or others and no change."""
        import rclpy
        limit = LONGEST if seconds is None else seconds
        seen = alone = self._graph()
        begin = changed = time.monotonic()
        while True:
            rclpy.spin_once(self.node, timeout_sec=0.05)
            now = time.monotonic()
            if (graph := self._graph()) != seen:
                seen, changed = graph, now
            complete = enough(self.node) if enough else seen != alone and now - changed > STILL
            if seconds is None and complete or now - begin >= limit:
                return

    def _graph(self) -> tuple[Any, ...]:
        return (sorted(self.node.get_node_names_and_namespaces()),
                self.node.get_topic_names_and_types(), self.node.get_service_names_and_types())

    def __enter__(self) -> DirectNode:
        return self

    def __getattr__(self, name: str) -> Any:
        return getattr(self.node, name)

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        import rclpy
        from rclpy.executors import ExternalShutdownException
        signalled = not rclpy.ok()
        self.node.destroy_node()
        rclpy.try_shutdown()
        if signalled and isinstance(error, Exception):
            # whatever failed because a signal had ended rclpy
            raise ExternalShutdownException from None


def add_arguments(parser: Any) -> None:
    """Add the options of such a node."""
    parser.add_argument('--spin-time', type=float, default=None,
                        help='Spin time in seconds to wait for discovery '
                             f'(default: until nothing changes, at most {LONGEST:g})')
    parser.add_argument('--no-daemon', action='store_true', help='Changes nothing here')
