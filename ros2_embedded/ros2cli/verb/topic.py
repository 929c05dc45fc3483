# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 topic`` that list, and what all its verbs share."""
from __future__ import annotations

import argparse
from typing import Any

from ros2cli.node.strategy import add_arguments, NodeStrategy
from ros2cli.verb import VerbExtension


def above(least: int, kind: Any = int) -> Any:
    """Make what reads a number that is greater than the least."""
    def number(text: str) -> Any:
        if kind(text) <= least:
            raise argparse.ArgumentTypeError(f'value must be greater than {least}')
        return kind(text)
    return number


def message_class(name: str, error: str = 'The passed message type is invalid') -> Any:
    """
    Return the class of a message type.

    :raises RuntimeError: with the error's text, if there is none of that name.
    """
    from rosidl_runtime_py.utilities import get_message
    try:
        return get_message(name)
    except (AttributeError, ModuleNotFoundError, ValueError):
        raise RuntimeError(error) from None


def topic_types(node: Any, topic: str) -> list[str] | None:
    """Return the types of a topic's messages, None if there is no such topic."""
    types: list[str] | None = dict(node.get_topic_names_and_types()).get(
        node.resolve_topic_name(topic))
    return types


def get_msg_class(node: Any, topic: str, blocking: bool = False) -> Any:
    """
    Find the class of a topic's messages.

    :param blocking: wait until somebody publishes or subscribes to it.
    :returns: None if there is no such topic.
    :raises RuntimeError: if it has several types, or an unknown one, or its name is invalid.
    """
    import rclpy
    types = topic_types(node, topic)
    if types is None:
        print(f'WARNING: topic [{topic}] does not appear to be published yet')
    while types is None and blocking and rclpy.ok():
        rclpy.spin_once(node, timeout_sec=0.1)
        types = topic_types(node, topic)
    if types is None:
        return None
    if len(types) > 1:
        raise RuntimeError(f"Cannot echo topic '{topic}', as it contains more than one type: "
                           f"[{', '.join(types)}]")
    return message_class(types[0], f"The message type '{types[0]}' is invalid")


def _policies() -> dict[str, Any]:
    from rclpy import qos
    return {'history': qos.HistoryPolicy, 'reliability': qos.ReliabilityPolicy,
            'durability': qos.DurabilityPolicy, 'liveliness': qos.LivelinessPolicy}


def add_qos_arguments(parser: Any, default: str) -> None:
    """Add the options for quality of service; default is a preset profile's name."""
    from rclpy import qos
    parser.add_argument(
        '--qos-profile', choices=qos.QoSPresetProfiles.short_keys(), default=default,
        help=f'Quality of service preset profile (default: {default})')
    parser.add_argument('--qos-depth', metavar='N', type=int,
                        help='Queue size (overrides depth value of --qos-profile option)')
    for name, policy in _policies().items():
        parser.add_argument(f'--qos-{name}', choices=policy.short_keys(),
                            help=f'overrides {name} value of --qos-profile option')


def qos_from_arguments(args: Any) -> Any:
    """Make the profile that the options describe."""
    from rclpy import qos
    profile = qos.QoSPresetProfiles.get_from_short_key(args.qos_profile)
    for name, policy in _policies().items():
        if (given := getattr(args, f'qos_{name}')) is not None:
            setattr(profile, name, policy.get_from_short_key(given))
    if args.qos_depth is not None and args.qos_depth > 0:
        profile.depth = args.qos_depth
    elif profile.durability == qos.DurabilityPolicy.TRANSIENT_LOCAL and profile.depth == 0:
        profile.depth = 1
    return profile


class ListVerb(VerbExtension):
    """Output a list of available topics."""

    WHAT = 'topic'

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        what = self.WHAT
        parser.add_argument('-t', '--show-types', action='store_true',
                            help=f'Additionally show the {what} type')
        parser.add_argument(f'--include-hidden-{what}s', action='store_true', dest='hidden',
                            help=f'Consider hidden {what}s as well')

    def main(self, *, args: Any) -> Any:
        from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden
        with NodeStrategy(args) as node:
            pairs = getattr(node, f'get_{self.WHAT}_names_and_types')()
            for name, types in pairs:
                if args.hidden or not topic_or_service_is_hidden(name):
                    print(f"{name} [{', '.join(types)}]" if args.show_types else name)


class InfoVerb(VerbExtension):
    """Print information about a topic."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        parser.add_argument(
            'topic_name', help="Name of the ROS topic to get info (e.g. '/chatter')")
        parser.add_argument(
            '--verbose', '-v', action='store_true',
            help='Prints node name, type hash, GUID and QoS of the publishers and subscriptions')

    def main(self, *, args: Any) -> Any:
        topic = args.topic_name
        end = '\n\n' if args.verbose else '\n'
        with NodeStrategy(args) as node:
            types = dict(node.get_topic_names_and_types()).get(topic)
            if types is None:
                return f"Unknown topic '{topic}'"
            print(f'Type: {types[0] if len(types) == 1 else types}', end=end)
            for what, count, infos in (
                    ('Publisher', node.count_publishers, node.get_publishers_info_by_topic),
                    ('Subscription', node.count_subscribers,
                     node.get_subscriptions_info_by_topic)):
                print(f'{what} count: {count(topic)}', end=end)
                if args.verbose:
                    for info in infos(topic):
                        print(info, end=end)
