# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 node``."""

import sys
from typing import Any

from ros2cli.node.strategy import add_arguments, NodeStrategy
from ros2cli.verb import VerbExtension

_FEEDBACK = '/_action/feedback'


def get_node_names(node: Any, include_hidden_nodes: bool = False) -> list[str]:
    """List the full names of nodes, sorted; hidden ones if asked for."""
    return sorted(f"{namespace.rstrip('/')}/{name}"
                  for name, namespace in node.get_node_names_and_namespaces()
                  if include_hidden_nodes or name and not name.startswith('_'))


def _actions(topics: list[tuple[str, list[str]]]) -> list[tuple[str, list[str]]]:
    """Return the actions whose feedback is among the topics."""
    return [(name.removesuffix(_FEEDBACK), [kind.removesuffix('_FeedbackMessage')
                                            for kind in kinds])
            for name, kinds in topics if name.endswith(_FEEDBACK)]


class ListVerb(VerbExtension):
    """Output a list of available nodes."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        parser.add_argument('-a', '--all', action='store_true',
                            help='Display all nodes even hidden ones')

    def main(self, *, args: Any) -> Any:
        with NodeStrategy(args) as node:
            names = get_node_names(node, args.all)
        if len(set(names)) < len(names):
            print('WARNING: Be aware that there are nodes in the graph that share an exact '
                  'name, which can have unintended side effects.', file=sys.stderr)
        for name in names:
            print(name)


class InfoVerb(VerbExtension):
    """Output information about a node."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        parser.add_argument('node_name', help='Node name to request information')
        parser.add_argument('--include-hidden', action='store_true',
                            help='Display hidden topics, services, and actions as well')

    def main(self, *, args: Any) -> Any:
        namespace, _, name = args.node_name.rpartition('/')
        with NodeStrategy(args) as node:
            count = get_node_names(node, args.include_hidden).count(args.node_name)
            if not count:
                return f"Unable to find node '{args.node_name}'"
            if count > 1:
                print(f'There are {count} nodes in the graph with the exact name '
                      f'"{args.node_name}". You are seeing information about only one of them.',
                      file=sys.stderr)
            print(args.node_name)
            where = name, namespace or '/'
            subscribed = node.get_subscriber_names_and_types_by_node(*where)
            published = node.get_publisher_names_and_types_by_node(*where)
            for title, pairs in (
                    ('Subscribers', subscribed), ('Publishers', published),
                    ('Service Servers', node.get_service_names_and_types_by_node(*where)),
                    ('Service Clients', node.get_client_names_and_types_by_node(*where)),
                    ('Action Servers', _actions(published)),
                    ('Action Clients', _actions(subscribed))):
                print(f'  {title}:')
                print(*[f"    {name}: {', '.join(types)}" for name, types in pairs
                        if args.include_hidden or '/_' not in name], sep='\n')
