# SPDX-License-Identifier: Apache-2.0
"""The verb ``ros2 topic echo``."""

from collections.abc import Callable
from typing import Any

from ros2cli.node.strategy import add_arguments as add_strategy_node_arguments
from ros2cli.node.strategy import NodeStrategy
from ros2cli.verb import VerbExtension
from ros2cli.verb.topic import (
    add_qos_arguments,
    get_msg_class,
    positive_float,
    qos_from_arguments,
    unsigned_int,
)

DEFAULT_TRUNCATE_LENGTH = 128


class EchoVerb(VerbExtension):
    """Output messages from a topic."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_strategy_node_arguments(parser)
        add = parser.add_argument
        add('topic_name', help="Name of the ROS topic to listen to (e.g. '/chatter')")
        add('message_type', nargs='?',
            help="Type of the ROS message (e.g. 'std_msgs/msg/String')")
        add_qos_arguments(parser, 'subscribe', 'sensor_data')
        add('--csv', action='store_true',
            help='Output all recursive fields separated by commas (e.g. for plotting). If '
                 '--include-message-info is also passed, the following fields are prepended: '
                 'source_timestamp, received_timestamp, publication_sequence_number, '
                 'reception_sequence_number.')
        add('--field', type=str, default=None,
            help="Echo a selected field of a message. Use '.' to select sub-fields. For example, "
                 'to echo the position field of a nav_msgs/msg/Odometry message: '
                 "'ros2 topic echo /odom --field pose.pose.position'")
        add('--full-length', '-f', action='store_true',
            help='Output all elements for arrays, bytes, and string with a length > '
                 "'--truncate-length', by default they are truncated after '--truncate-length' "
                 "elements with '...''")
        add('--truncate-length', '-l', type=unsigned_int, default=DEFAULT_TRUNCATE_LENGTH,
            help='The length to truncate arrays, bytes, and string to '
                 f'(default: {DEFAULT_TRUNCATE_LENGTH})')
        add('--no-arr', action='store_true', help="Don't print array fields of messages")
        add('--no-str', action='store_true', help="Don't print string fields of messages")
        add('--flow-style', action='store_true',
            help='Print collections in the block style (not available with csv format)')
        add('--no-lost-messages', action='store_true',
            help="Don't report when a message is lost")
        add('--raw', action='store_true', help='Echo the raw binary representation')
        add('--filter', dest='filter_expr',
            help='Python expression to filter messages that are printed. Expression can use '
                 'Python builtins as well as m (the message).')
        add('--once', action='store_true',
            help='Print the first message received and then exit.')
        add('--timeout', metavar='N', type=positive_float, default=None,
            help='Set a timeout in seconds for waiting')
        add('--include-message-info', '-i', action='store_true',
            help='Shows the associated message info.')

    def _profile(self, node: Any, args: Any) -> Any:
        """Make a profile that goes together with all publishers, unless options say another."""
        from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
        profile = qos_from_arguments(args)
        if any(getattr(args, f'qos_{name}') is not None for name in (
                'reliability', 'durability', 'depth', 'history', 'liveliness',
                'liveliness_lease_duration_seconds')):
            return profile
        offered = [info.qos_profile for info in node.get_publishers_info_by_topic(
            args.topic_name)]
        for name, strict, weak in (
                ('reliability', ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT),
                ('durability', DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE)):
            count = sum(getattr(one, name) == strict for one in offered)
            if not offered:
                continue
            if 0 < count < len(offered):
                kind = f'QoS{name.capitalize()}Policy'
                print(f'Some, but not all, publishers are offering {kind}.{strict.name}. Falling '
                      f'back to {kind}.{weak.name} as it will connect to all publishers')
            setattr(profile, name, strict if count == len(offered) else weak)
        return profile

    def main(self, *, args: Any) -> Any:
        import rclpy
        from rclpy.event_handler import SubscriptionEventCallbacks
        from rclpy.task import Future
        from rosidl_runtime_py.utilities import get_message
        fields = [name for name in (args.field or '').split('.') if name]
        if args.field is not None and not fields:
            raise RuntimeError(f"Invalid field value '{args.field}'")
        with NodeStrategy(args) as strategy:
            node = strategy.node
            profile = self._profile(node, args)
            if args.message_type is None:
                kind = get_msg_class(node, args.topic_name, include_hidden_topics=True)
            else:
                try:
                    kind = get_message(args.message_type)
                except (AttributeError, ModuleNotFoundError, ValueError):
                    raise RuntimeError('The passed message type is invalid') from None
            if kind is None:
                raise RuntimeError('Could not determine the type for the passed topic')
            future = Future() if args.timeout or args.once else None
            if future is not None and args.timeout:
                node.create_timer(args.timeout, lambda: future.set_result(True))
            events = None if args.no_lost_messages else SubscriptionEventCallbacks(
                message_lost=_report_lost)
            node.create_subscription(
                kind, args.topic_name, _printer(args, fields, future), profile,
                event_callbacks=events, raw=args.raw)
            if future is not None:
                rclpy.spin_until_future_complete(node, future)
            else:
                rclpy.spin(node)


def _report_lost(status: Any) -> None:
    print('A message was lost!!!\n\ttotal count change:'
          f'{status.total_count_change}\n\ttotal count: {status.total_count}', end='---\n')


def _printer(args: Any, fields: list[str], future: Any) -> Callable[[Any, dict[str, Any]], None]:
    """Make the callback that prints messages as the options say."""
    from rosidl_runtime_py import message_to_csv, message_to_yaml
    wanted = compile(args.filter_expr, '<filter>', 'eval') if args.filter_expr else None
    options = {'truncate_length': None if args.full_length else args.truncate_length,
               'no_arr': args.no_arr, 'no_str': args.no_str}

    def show(message: Any, info: dict[str, Any]) -> None:
        part = message
        for name in fields:
            try:
                part = getattr(part, name)
            except AttributeError as error:
                raise RuntimeError(f"Invalid field '{'.'.join(fields)}': {error}") from error
        if wanted is not None and not eval(wanted, {'m': part}):  # noqa: S307 - the user's own
            return
        if future is not None and args.once:
            future.set_result(True)
        if not hasattr(part, '_definition'):
            if args.include_message_info:
                print('---Got new message, message info:---', info, '---Message data:---',
                      sep='\n')
            print(part, end='\n---\n')
        elif args.csv:
            text = message_to_csv(part, **options)
            if args.include_message_info:
                text = f"{','.join(map(str, info.values()))},{text}"
            print(text)
        else:
            if args.include_message_info:
                import yaml
                print(yaml.dump(info), end='---\n')
            print(message_to_yaml(part, flow_style=args.flow_style, **options), end='---\n')

    return show
