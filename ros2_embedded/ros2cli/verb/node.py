# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 node``."""

import sys
import time
from typing import Any, NamedTuple

from ros2cli.node.strategy import add_arguments, NodeStrategy
from ros2cli.verb import VerbExtension


class NodeName(NamedTuple):
    """A node's name."""

    name: str
    namespace: str
    full_name: str


def get_absolute_node_name(node_name: str) -> str:
    """Give a name its leading slash."""
    return node_name if node_name.startswith('/') else f'/{node_name}'


def parse_node_name(node_name: str) -> NodeName:
    """Split a name into name and namespace."""
    full = get_absolute_node_name(node_name)
    namespace, _, name = full.rpartition('/')
    return NodeName(name, namespace or '/', full)


def get_node_names(*, node: Any, include_hidden_nodes: bool = False) -> list[NodeName]:
    """List the nodes; hidden ones if asked for."""
    return [NodeName(name, namespace, f"{namespace.rstrip('/')}/{name}")
            for name, namespace in node.get_node_names_and_namespaces()
            if include_hidden_nodes or name and not name.startswith('_')]


def wait_for_node(node: Any, node_name: str, include_hidden_nodes: bool = False,
                  timeout: float = 1.0) -> bool:
    """Wait for a node for a number of seconds."""
    limit = time.monotonic() + timeout
    while True:
        names = get_node_names(node=node, include_hidden_nodes=include_hidden_nodes)
        if node_name in {name.full_name for name in names}:
            return True
        if time.monotonic() > limit:
            return False
        time.sleep(0.02)


class ListVerb(VerbExtension):
    """Output a list of available nodes."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        parser.add_argument('-a', '--all', action='store_true',
                            help='Display all nodes even hidden ones')
        parser.add_argument('-c', '--count-nodes', action='store_true',
                            help='Only display the number of nodes discovered')

    def main(self, *, args: Any) -> Any:
        with NodeStrategy(args) as node:
            names = sorted(name.full_name for name in get_node_names(
                node=node, include_hidden_nodes=args.all))
        if args.count_nodes:
            print(len(names))
            return
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
        wanted = parse_node_name(args.node_name)
        with NodeStrategy(args) as node:
            names = get_node_names(node=node, include_hidden_nodes=args.include_hidden)
            count = [name.full_name for name in names].count(args.node_name)
            if not count:
                return f"Unable to find node '{args.node_name}'"
            if count > 1:
                print(f'There are {count} nodes in the graph with the exact name '
                      f'"{args.node_name}". You are seeing information about only one of them.',
                      file=sys.stderr)
            print(args.node_name)
            for title, listed in (
                    ('Subscribers', node.get_subscriber_names_and_types_by_node),
                    ('Publishers', node.get_publisher_names_and_types_by_node),
                    ('Service Servers', node.get_service_names_and_types_by_node),
                    ('Service Clients', node.get_client_names_and_types_by_node),
                    ('Action Servers', None), ('Action Clients', None)):
                pairs = [] if listed is None else listed(wanted.name, wanted.namespace)
                print(f'  {title}:')
                print(*[f"    {name}: {', '.join(types)}" for name, types in pairs
                        if args.include_hidden or '/_' not in name], sep='\n')
