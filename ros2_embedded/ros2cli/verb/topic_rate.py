# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 topic`` that measure: hz and bw."""
from __future__ import annotations

from collections import deque
import statistics
from typing import Any

from ros2cli.node.direct import add_arguments, DirectNode
from ros2cli.verb import VerbExtension
from ros2cli.verb.topic import above, get_msg_class, topic_types


def _measure(args: Any, topic: str, callback: Any, report: Any) -> None:
    """Subscribe to a topic's bytes and report each second, until the end."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    with DirectNode(args, enough=lambda node: topic_types(node, topic) is not None) as direct:
        node = direct.node
        kind = get_msg_class(node, topic, blocking=True)
        if kind is None:
            return
        clock = node.get_clock()
        node.create_subscription(
            kind, topic, lambda data: callback(data, clock.now().nanoseconds),
            qos_profile_sensor_data, raw=True)
        node.create_timer(1.0, lambda: report(clock.now().nanoseconds))
        while rclpy.ok():
            rclpy.spin_once(node)


class HzVerb(VerbExtension):
    """Print the average publishing rate to screen."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        parser.add_argument(
            'topic_name', help="Name of the ROS topic to listen to (e.g. '/chatter')")
        parser.add_argument(
            '--window', '-w', dest='window_size', type=above(0), default=10000,
            metavar='WINDOW',
            help='window size, in # of messages, for calculating rate (default: 10000)')
        add_arguments(parser)

    def main(self, *, args: Any) -> Any:
        gaps: deque[float] = deque(maxlen=args.window_size)
        last: int | None = None
        reported: int | None = None

        def received(data: bytes, now: int) -> None:
            nonlocal last
            if last is not None and now >= last:
                gaps.append((now - last) / 1e9)
            elif last is not None:
                print('time has reset, resetting counters')
                gaps.clear()
            last = now

        def report(now: int) -> None:
            nonlocal reported
            if not gaps or reported == last:
                return
            reported = last
            mean = statistics.fmean(gaps)
            print(f'average rate: {1.0 / mean if mean else 0:.3f}\n\tmin: {min(gaps):.3f}s '
                  f'max: {max(gaps):.3f}s std dev: {statistics.pstdev(gaps, mean):.5f}s '
                  f'window: {len(gaps)}')

        _measure(args, args.topic_name, received, report)


class BwVerb(VerbExtension):
    """Display bandwidth used by topic."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        parser.add_argument('topic', help='Topic name to monitor for bandwidth utilization')
        parser.add_argument(
            '--window', '-w', type=above(0), default=100, metavar='WINDOW',
            help='maximum window size, in # of messages, for calculating rate (default: 100)')
        add_arguments(parser)

    def main(self, *, args: Any) -> Any:
        received: deque[tuple[int, int]] = deque(maxlen=args.window)

        def report(now: int) -> None:
            if len(received) < 2 or now <= received[0][0]:
                return
            sizes = [size for _, size in received]
            rate = sum(sizes) / ((now - received[0][0]) / 1e9)
            divisor, unit = (1, 'B') if rate < 1e3 else (1e3, 'KB') if rate < 1e6 else (1e6, 'MB')

            def text(value: float) -> str:
                return f'{value:.0f} B' if unit == 'B' else f'{value / divisor:.2f} {unit}'

            print(f'{text(rate)}/s from {len(sizes)} messages\n\tMessage size mean: '
                  f'{text(sum(sizes) / len(sizes))} min: {text(min(sizes))} '
                  f'max: {text(max(sizes))}')

        print(f'Subscribed to [{args.topic}]')
        _measure(args, args.topic, lambda data, now: received.append((now, len(data))), report)
