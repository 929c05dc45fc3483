# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 topic`` that measure: hz, bw, delay."""

from collections import deque
import math
from typing import Any

from ros2cli.node.direct import add_arguments as add_direct_node_arguments
from ros2cli.node.direct import DirectNode
from ros2cli.verb import VerbExtension
from ros2cli.verb.topic import get_msg_class, positive_int


def _measure(args: Any, topic: str, callback: Any, report: Any, raw: bool) -> None:
    """Subscribe to a topic and report each second, until the end."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    with DirectNode(args) as direct:
        node = direct.node
        kind = get_msg_class(node, topic, blocking=True, include_hidden_topics=True)
        if kind is None:
            return
        clock = node.get_clock()
        node.create_subscription(
            kind, topic, lambda message: callback(message, clock.now().nanoseconds),
            qos_profile_sensor_data, raw=raw)
        node.create_timer(1.0, lambda: report(clock.now().nanoseconds))
        while rclpy.ok():
            rclpy.spin_once(node)


def _filter(expression: str | None) -> Any:
    if expression is None:
        return lambda message: True
    code = compile(expression, '<filter>', 'eval')
    return lambda message: eval(code, {'m': message})  # noqa: S307 - the user's own


def _spread(values: 'deque[float]') -> tuple[float, float, float, float]:
    """Give mean, least, greatest and standard deviation."""
    mean = sum(values) / len(values)
    deviation = math.sqrt(sum((value - mean) ** 2 for value in values) / len(values))
    return mean, min(values), max(values), deviation


class HzVerb(VerbExtension):
    """Print the average publishing rate to screen."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        parser.add_argument(
            'topic_name', help="Name of the ROS topic to listen to (e.g. '/chatter')")
        parser.add_argument(
            '--window', '-w', dest='window_size', type=positive_int, default=10000,
            metavar='WINDOW',
            help='window size, in # of messages, for calculating rate (default: 10000)')
        parser.add_argument(
            '--filter', dest='filter_expr', default=None, metavar='EXPR',
            help='only measure messages matching the specified Python expression')
        parser.add_argument(
            '--wall-time', dest='use_wtime', default=False, action='store_true',
            help='calculates rate using wall time which can be helpful when clock is not '
                 'published during simulation')
        add_direct_node_arguments(parser)

    def main(self, *, args: Any) -> Any:
        import time
        wanted = _filter(args.filter_expr)
        gaps: deque[float] = deque(maxlen=args.window_size)
        last: list[int] = []
        fresh: list[bool] = []

        def received(message: Any, now: int) -> None:
            if not wanted(message):
                return
            now = time.time_ns() if args.use_wtime else now
            if last and now >= last[0]:
                gaps.append((now - last[0]) / 1e9)
                fresh[:] = [True]
            elif last:
                print('time has reset, resetting counters')
                gaps.clear()
            last[:] = [now]

        def report(now: int) -> None:
            if not gaps or not fresh:
                return
            fresh.clear()
            mean, least, greatest, deviation = _spread(gaps)
            print(f'average rate: {1.0 / mean if mean else 0:.3f}\n\tmin: {least:.3f}s '
                  f'max: {greatest:.3f}s std dev: {deviation:.5f}s window: {len(gaps)}')

        _measure(args, args.topic_name, received, report, raw=args.filter_expr is None)


class BwVerb(VerbExtension):
    """Display bandwidth used by topic."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        parser.add_argument('topic', help='Topic name to monitor for bandwidth utilization')
        parser.add_argument(
            '--window', '-w', type=positive_int, default=100, metavar='WINDOW',
            help='maximum window size, in # of messages, for calculating rate (default: 100)')
        add_direct_node_arguments(parser)

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
        _measure(args, args.topic, lambda data, now: received.append((now, len(data))), report,
                 raw=True)
