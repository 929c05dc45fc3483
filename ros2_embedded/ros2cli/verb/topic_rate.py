# SPDX-License-Identifier: Apache-2.0
"""The verb ``ros2 topic hz``."""
from __future__ import annotations

from collections import deque
import statistics
import time
from typing import Any

from ros2cli.node.direct import add_arguments, DirectNode
from ros2cli.verb import VerbExtension
from ros2cli.verb.topic import get_msg_class, topic_types


class HzVerb(VerbExtension):
    """Print the average publishing rate to screen."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        parser.add_argument(
            'topic_name', help="Name of the ROS topic to listen to (e.g. '/chatter')")
        add_arguments(parser)

    def main(self, *, args: Any) -> Any:
        import rclpy
        from rclpy.qos import qos_profile_sensor_data
        topic = args.topic_name
        times: deque[float] = deque(maxlen=10001)
        reported = 0.0

        def report() -> None:
            nonlocal reported
            if len(times) < 2 or reported == times[-1]:
                return
            reported = times[-1]
            gaps = [after - before for before, after in zip(times, [*times][1:])]
            mean = statistics.fmean(gaps)
            print(f'average rate: {1.0 / mean:.3f}\n\tmin: {min(gaps):.3f}s '
                  f'max: {max(gaps):.3f}s std dev: {statistics.pstdev(gaps, mean):.5f}s '
                  f'window: {len(gaps)}')

        with DirectNode(args, enough=lambda node: topic_types(node, topic) is not None) as direct:
            node = direct.node
            kind = get_msg_class(node, topic, blocking=True)
            if kind is None:
                return
            node.create_subscription(kind, topic, lambda _: times.append(time.monotonic()),
                                     qos_profile_sensor_data, raw=True)
            node.create_timer(1.0, report)
            while rclpy.ok():
                rclpy.spin_once(node)
