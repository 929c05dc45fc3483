# SPDX-License-Identifier: Apache-2.0
"""The verb ``ros2 topic pub``."""
from __future__ import annotations

import time
from typing import Any

from ros2cli.node.direct import add_arguments, DirectNode
from ros2cli.verb import VerbExtension
from ros2cli.verb.topic import above, add_qos_arguments, message_class, qos_from_arguments

_WAIT = 0.1  # seconds between looks for subscriptions, and before the end


class PubVerb(VerbExtension):
    """Publish a message to a topic."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add = parser.add_argument
        add('topic_name', help="Name of the ROS topic to publish to (e.g. '/chatter')")
        add('message_type', help="Type of the ROS message (e.g. 'std_msgs/String')")
        add('values', nargs='?', default='{}',
            help="Values to fill the message with in YAML format (e.g. 'data: Hello World')")
        add('-r', '--rate', metavar='N', type=above(0, float), default=1.0,
            help='Publishing rate in Hz (default: 1)')
        group = parser.add_mutually_exclusive_group()
        group.add_argument('-1', '--once', action='store_const', dest='times', const=1,
                           default=0, help='Publish one message and exit')
        group.add_argument('-t', '--times', type=above(-1), default=0,
                           help='Publish this number of times and then exit')
        add('-w', '--wait-matching-subscriptions', type=above(-1), default=None,
            help='Wait for so many subscriptions; by default 1 with -1 or -t, otherwise 0')
        add('-n', '--node-name', help='Name of the created publishing node')
        add_qos_arguments(parser, 'default')
        add_arguments(parser)

    def main(self, *, args: Any) -> Any:
        with DirectNode(args, node_name=args.node_name, enough=lambda node: True) as direct:
            return _publish(direct.node, args)


def _publish(node: Any, args: Any) -> str | None:
    import rclpy
    from rosidl_runtime_py import set_message_fields
    import yaml
    kind = message_class(args.message_type)
    values = yaml.safe_load(args.values)
    if not isinstance(values, dict):
        return 'The passed value needs to be a dictionary in YAML format'
    publisher = node.create_publisher(kind, args.topic_name, qos_from_arguments(args))
    wanted = args.wait_matching_subscriptions
    wanted = int(args.times != 0) if wanted is None else wanted
    if wanted:
        print(f'Waiting for at least {wanted} matching subscription(s)...')
        while publisher.get_subscription_count() < wanted:
            rclpy.spin_once(node, timeout_sec=_WAIT)  # raises when a signal has come
        time.sleep(_WAIT)  # until the subscriptions know this publisher, too
    message = kind()
    try:
        set_message_fields(message, values)
    except (AssertionError, AttributeError, TypeError, ValueError) as error:
        return f'Failed to populate field: {error}'
    print('publisher: beginning loop')
    count = 0

    def publish() -> None:
        nonlocal count
        count += 1
        print(f'publishing #{count}: {message!r}\n')
        publisher.publish(message)

    publish()
    if args.times != 1:
        node.create_timer(1.0 / args.rate, publish)
        while args.times == 0 or count < args.times:
            rclpy.spin_once(node)
    time.sleep(_WAIT)  # what was written last is still on its way
    return None
