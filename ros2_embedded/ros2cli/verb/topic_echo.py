# SPDX-License-Identifier: Apache-2.0
"""The verb ``ros2 topic echo``."""
from __future__ import annotations

from typing import Any

from ros2cli.node.strategy import add_arguments, NodeStrategy
from ros2cli.verb import topic, VerbExtension


class EchoVerb(VerbExtension):
    """Output messages from a topic."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        add = parser.add_argument
        add('topic_name', help="Name of the ROS topic to listen to (e.g. '/chatter')")
        add('message_type', nargs='?', help="Type of the message (e.g. 'std_msgs/msg/String')")
        topic.add_qos_arguments(parser, 'sensor_data')
        add('--field', help="Echo a selected field of a message, such as 'pose.pose.position'")
        add('--full-length', '-f', action='store_true',
            help='Output all elements of arrays, bytes and strings')
        add('--truncate-length', '-l', type=topic.above(-1), default=128,
            help='The length to truncate arrays, bytes, and string to (default: 128)')
        add('--no-arr', action='store_true', help="Don't print array fields of messages")
        add('--no-str', action='store_true', help="Don't print string fields of messages")
        add('--once', action='store_true', help='Print the first message received and exit')

    def _profile(self, node: Any, args: Any) -> Any:
        """Make a profile that goes together with all publishers, unless options say another."""
        from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
        profile = topic.qos_from_arguments(args)
        offered = [info.qos_profile for info in node.get_publishers_info_by_topic(
            args.topic_name)]
        if not offered or any(value is not None and name != 'qos_profile'
                              for name, value in vars(args).items() if name.startswith('qos_')):
            return profile
        for name, strict, weak in (
                ('reliability', ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT),
                ('durability', DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE)):
            count = sum(getattr(one, name) == strict for one in offered)
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
        with NodeStrategy(args) as strategy:
            node = strategy.node
            profile = self._profile(node, args)
            kind = (topic.message_class(args.message_type) if args.message_type
                    else topic.get_msg_class(node, args.topic_name))
            if kind is None:
                raise RuntimeError('Could not determine the type for the passed topic')
            done = Future()
            events = SubscriptionEventCallbacks(message_lost=lambda status: print(
                f'A message was lost!!!\n\ttotal count change:{status.total_count_change}\n\t'
                f'total count: {status.total_count}', end='---\n'))
            node.create_subscription(
                kind, args.topic_name, _printer(args, done), profile, event_callbacks=events)
            rclpy.spin_until_future_complete(node, done)


def _printer(args: Any, done: Any) -> Any:
    """Make the callback that prints messages as the options say."""
    from rosidl_runtime_py import message_to_yaml
    fields = [name for name in (args.field or '').split('.') if name]
    length = None if args.full_length else args.truncate_length

    def show(message: Any) -> None:
        for name in fields:
            try:
                message = getattr(message, name)
            except AttributeError as error:
                raise RuntimeError(f"Invalid field '{args.field}': {error}") from error
        if args.once:
            done.set_result(True)
        if not hasattr(message, 'get_fields_and_field_types'):
            print(message, end='\n---\n')
        else:
            print(message_to_yaml(message, truncate_length=length, no_arr=args.no_arr,
                                  no_str=args.no_str), end='---\n')

    return show
