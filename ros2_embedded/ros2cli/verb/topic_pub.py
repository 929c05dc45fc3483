# SPDX-License-Identifier: Apache-2.0
"""The verb ``ros2 topic pub``."""

import sys
import time
from typing import Any

from ros2cli.node.direct import add_arguments as add_direct_node_arguments
from ros2cli.node.direct import DirectNode
from ros2cli.verb import VerbExtension
from ros2cli.verb.topic import add_qos_arguments, positive_float, qos_from_arguments, unsigned_int

_WAIT = 0.1  # seconds between looks for subscriptions


class PubVerb(VerbExtension):
    """Publish a message to a topic."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add = parser.add_argument
        add('topic_name', help="Name of the ROS topic to publish to (e.g. '/chatter')")
        add('message_type', help="Type of the ROS message (e.g. 'std_msgs/String')")
        group = parser.add_mutually_exclusive_group()
        group.add_argument(
            'values', nargs='?', default='{}',
            help="Values to fill the message with in YAML format (e.g. 'data: Hello World'), "
                 'otherwise the message will be published with default values')
        group.add_argument('--stdin', action='store_true',
                           help='Read values from standard input')
        add('-r', '--rate', metavar='N', type=positive_float, default=1.0,
            help='Publishing rate in Hz (default: 1)')
        add('-p', '--print', metavar='N', type=int, default=1,
            help='Only print every N-th published message (default: 1)')
        group = parser.add_mutually_exclusive_group()
        group.add_argument('-1', '--once', action='store_true',
                           help='Publish one message and exit')
        group.add_argument('-t', '--times', type=unsigned_int, default=0,
                           help='Publish this number of times and then exit')
        add('-w', '--wait-matching-subscriptions', type=unsigned_int, default=None,
            help='Wait until finding the specified number of matching subscriptions. Defaults to '
                 '1 when using "-1"/"--once"/"--times", otherwise defaults to 0.')
        add('--max-wait-time-secs', type=positive_float, default=None,
            help='This sets the maximum wait time in seconds if --wait-until-matching-'
                 'subscriptions is set. By default, this flag is not set meaning the subscriber '
                 'will wait endlessly.')
        add('--keep-alive', metavar='N', type=positive_float, default=0.1,
            help='Keep publishing node alive for N seconds after the last msg (default: 0.1)')
        add('-n', '--node-name', help='Name of the created publishing node')
        add_qos_arguments(parser, 'publish', 'default')
        add_direct_node_arguments(parser)

    def main(self, *, args: Any) -> Any:
        import yaml
        times = 1 if args.once else args.times
        values = yaml.safe_load(sys.stdin.read() if args.stdin else args.values)
        wait = args.wait_matching_subscriptions
        wait = int(times != 0) if wait is None else wait
        with DirectNode(args, node_name=args.node_name) as direct:
            return _publish(direct.node, args, values, times, wait)


def _wait(publisher: Any, wanted: int, limit: float | None) -> str | None:
    """Wait for subscriptions; say what went wrong if it did."""
    waited = 0
    while (count := publisher.get_subscription_count()) < wanted:
        if waited % 10 == 0:
            print(f'Waiting for at least {wanted} matching subscription(s)...')
        if limit is not None and waited * _WAIT >= limit:
            return (f'Timed out waiting for subscribers: Expected {wanted} subcribers but only '
                    f'got {count} subscribers')
        waited += 1
        time.sleep(_WAIT)
    return None


def _publish(node: Any, args: Any, values: Any, times: int, wait: int) -> str | None:
    import rclpy
    from rosidl_runtime_py import set_message_fields
    from rosidl_runtime_py.utilities import get_message
    try:
        kind = get_message(args.message_type)
    except (AttributeError, ModuleNotFoundError, ValueError):
        raise RuntimeError('The passed message type is invalid') from None
    if not isinstance(values, dict):
        return 'The passed value needs to be a dictionary in YAML format'
    publisher = node.create_publisher(kind, args.topic_name, qos_from_arguments(args))
    if wait == 0 and args.max_wait_time_secs is not None:
        return ('--max-wait-time-secs option is only effective with '
                '--wait-matching-subscriptions, --once or --times')
    if (problem := _wait(publisher, wait, args.max_wait_time_secs)) is not None:
        return problem
    message = kind()
    try:
        stamps = set_message_fields(
            message, values, expand_header_auto=True, expand_time_now=True)
    except (AssertionError, AttributeError, TypeError, ValueError) as error:
        return f'Failed to populate field: {error}'
    print('publisher: beginning loop')
    count = 0

    def publish() -> None:
        nonlocal count
        now = node.get_clock().now().to_msg()
        for set_stamp in stamps:
            set_stamp(now)
        count += 1
        if args.print and count % args.print == 0:
            print(f'publishing #{count}: {message!r}\n')
        publisher.publish(message)

    publish()
    if times != 1:
        node.create_timer(1.0 / args.rate, publish)
        while times == 0 or count < times:
            rclpy.spin_once(node)
    time.sleep(args.keep_alive)  # what was written last is still on its way
    return None
