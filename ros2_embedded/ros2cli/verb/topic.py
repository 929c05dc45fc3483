# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 topic`` that list, and what all its verbs share."""

import argparse
from typing import Any

from ros2cli.node.strategy import add_arguments as add_strategy_node_arguments
from ros2cli.node.strategy import NodeStrategy
from ros2cli.verb import VerbExtension

NamesAndTypes = list[tuple[str, list[str]]]


def positive_int(text: str) -> int:
    """Read a number above zero."""
    if not text.isdigit() or int(text) == 0:
        raise argparse.ArgumentTypeError('value must be a positive integer')
    return int(text)


def unsigned_int(text: str) -> int:
    """Read a number from zero on."""
    if not text.isdigit():
        raise argparse.ArgumentTypeError('value must be positive or zero')
    return int(text)


def positive_float(text: str) -> float:
    """Read a number above zero."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError('Expects a floating point number') from None
    if value <= 0.0:
        raise argparse.ArgumentTypeError('Value must be positive')
    return value


def get_topic_names_and_types(*, node: Any, include_hidden_topics: bool = False) -> NamesAndTypes:
    """List topics with their types; hidden ones if asked for."""
    from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden
    return [(name, types) for name, types in node.get_topic_names_and_types()
            if include_hidden_topics or not topic_or_service_is_hidden(name)]


def get_msg_class(node: Any, topic: str, blocking: bool = False,
                  include_hidden_topics: bool = False) -> Any:
    """
    Find the class of a topic's messages.

    :param blocking: wait until somebody publishes or subscribes to it.
    :returns: None if there is no such topic.
    :raises RuntimeError: if it has several types, or an unknown one, or its name is invalid.
    """
    import rclpy
    found = _find_class(node, topic, include_hidden_topics)
    if found is None:
        print(f'WARNING: topic [{topic}] does not appear to be published yet')
    while found is None and blocking and rclpy.ok():
        rclpy.spin_once(node, timeout_sec=0.1)
        found = _find_class(node, topic, include_hidden_topics)
    return found


def _find_class(node: Any, topic: str, include_hidden_topics: bool) -> Any:
    from rclpy.exceptions import InvalidTopicNameException
    from rclpy.expand_topic_name import expand_topic_name
    from rclpy.validate_full_topic_name import validate_full_topic_name
    from rosidl_runtime_py.utilities import get_message
    try:
        full = expand_topic_name(topic, node.get_name(), node.get_namespace())
        validate_full_topic_name(full)
    except (ValueError, InvalidTopicNameException) as error:
        raise RuntimeError(str(error)) from error
    listed = get_topic_names_and_types(node=node, include_hidden_topics=include_hidden_topics)
    types = dict(listed).get(full)
    if types is None:
        return None
    if len(types) > 1:
        raise RuntimeError(f"Cannot echo topic '{topic}', as it contains more than one type: "
                           f"[{', '.join(types)}]")
    try:
        return get_message(types[0])
    except (AttributeError, ModuleNotFoundError, ValueError):
        raise RuntimeError(f"The message type '{types[0]}' is invalid") from None


def add_qos_arguments(parser: Any, what: str, default: str) -> None:
    """Add the options for quality of service; ``what`` is 'subscribe' or 'publish'."""
    from rclpy import qos
    preset = qos.QoSPresetProfiles.get_from_short_key(default)

    def over(policy: str, otherwise: str = '') -> str:
        return (f'Quality of service {policy} setting to {what} with (overrides {policy} value '
                f'of --qos-profile option{otherwise})')

    parser.add_argument(
        '--qos-profile', choices=qos.QoSPresetProfiles.short_keys(), default=default,
        help=f'Quality of service preset profile to {what} with (default: {default})')
    parser.add_argument(
        '--qos-depth', metavar='N', type=int,
        help=f'Queue size setting to {what} with '
             '(overrides depth value of --qos-profile option)')
    parser.add_argument(
        '--qos-history', choices=qos.HistoryPolicy.short_keys(),
        help=f'History of samples setting to {what} with (overrides history value of '
             f'--qos-profile option, default: {preset.history.short_key})')
    compatible = ', default: Compatible profile with running endpoints '
    parser.add_argument('--qos-reliability', choices=qos.ReliabilityPolicy.short_keys(),
                        help=over('reliability', compatible))
    parser.add_argument('--qos-durability', choices=qos.DurabilityPolicy.short_keys(),
                        help=over('durability', compatible))
    parser.add_argument('--qos-liveliness', choices=qos.LivelinessPolicy.short_keys(),
                        help=over('liveliness'))
    parser.add_argument('--qos-liveliness-lease-duration-seconds', type=float,
                        help=over('liveliness lease duration'))


def qos_from_arguments(args: Any) -> Any:
    """Make the profile that the options describe."""
    from rclpy import qos
    from rclpy.duration import Duration
    profile = qos.QoSPresetProfiles.get_from_short_key(args.qos_profile)
    for name, policy in (('history', qos.HistoryPolicy), ('durability', qos.DurabilityPolicy),
                         ('reliability', qos.ReliabilityPolicy),
                         ('liveliness', qos.LivelinessPolicy)):
        if (given := getattr(args, f'qos_{name}')) is not None:
            setattr(profile, name, policy.get_from_short_key(given))
    lease = args.qos_liveliness_lease_duration_seconds
    if lease is not None and lease >= 0:
        profile.liveliness_lease_duration = Duration(seconds=lease)
    if args.qos_depth is not None and args.qos_depth > 0:
        profile.depth = args.qos_depth
    elif profile.durability == qos.DurabilityPolicy.TRANSIENT_LOCAL and profile.depth == 0:
        profile.depth = 1
    return profile


class ListVerb(VerbExtension):
    """Output a list of available topics."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_strategy_node_arguments(parser)
        parser.add_argument('-t', '--show-types', action='store_true',
                            help='Additionally show the topic type')
        parser.add_argument('-c', '--count-topics', action='store_true',
                            help='Only display the number of topics discovered')
        parser.add_argument('--include-hidden-topics', action='store_true',
                            help='Consider hidden topics as well')
        parser.add_argument('-v', '--verbose', action='store_true',
                            help='List full details about each topic')

    @staticmethod
    def _print_counts(title: str, one: str, rows: list[tuple[str, list[str], int]]) -> None:
        print(f'{title} topics:')
        for name, types, count in rows:
            if count:
                print(f" * {name} [{', '.join(types)}] {count} {one}{'s' if count > 1 else ''}")
        print()

    def main(self, *, args: Any) -> Any:
        with NodeStrategy(args) as node:
            topics = get_topic_names_and_types(
                node=node, include_hidden_topics=args.include_hidden_topics)
            counts = {name: (node.count_publishers(name), node.count_subscribers(name))
                      for name, _ in topics} if args.verbose else {}
        if args.count_topics:
            print(len(topics))
        elif args.verbose and topics:
            self._print_counts('Published', 'publisher',
                               [(name, types, counts[name][0]) for name, types in topics])
            self._print_counts('Subscribed', 'subscriber',
                               [(name, types, counts[name][1]) for name, types in topics])
        else:
            for name, types in topics:
                print(f"{name} [{', '.join(types)}]" if args.show_types else name)


class InfoVerb(VerbExtension):
    """Print information about a topic."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_strategy_node_arguments(parser)
        parser.add_argument(
            'topic_name', help="Name of the ROS topic to get info (e.g. '/chatter')")
        parser.add_argument(
            '--verbose', '-v', action='store_true',
            help='Prints detailed information like the node name, node namespace, topic type, '
                 'topic type hash, GUID, and QoS Profile of the publishers and subscribers to '
                 'this topic')

    def main(self, *, args: Any) -> Any:
        topic = args.topic_name
        end = '\n\n' if args.verbose else '\n'
        with NodeStrategy(args) as node:
            types = dict(get_topic_names_and_types(node=node, include_hidden_topics=True)).get(
                topic)
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


class TypeVerb(VerbExtension):
    """Print a topic's type."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_strategy_node_arguments(parser)
        parser.add_argument(
            'topic_name', help="Name of the ROS topic to get type (e.g. '/chatter')")

    def main(self, *, args: Any) -> Any:
        with NodeStrategy(args) as node:
            topics = get_topic_names_and_types(
                node=node, include_hidden_topics=args.include_hidden_topics)
        types = dict(topics).get(args.topic_name)
        for kind in types or []:
            print(kind)
        return 1 if types is None else 0
