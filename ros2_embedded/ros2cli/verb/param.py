# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 param``."""
from __future__ import annotations

import sys
from typing import Any

from ros2cli.node.strategy import add_arguments, NodeStrategy
from ros2cli.verb import VerbExtension
from ros2cli.verb.node import get_node_names

_LABELS = {'BOOL': 'Boolean value is:', 'INTEGER': 'Integer value is:',
           'DOUBLE': 'Double value is:', 'STRING': 'String value is:',
           'BYTE_ARRAY': 'Byte values are:', 'BOOL_ARRAY': 'Boolean values are:',
           'INTEGER_ARRAY': 'Integer values are:', 'DOUBLE_ARRAY': 'Double values are:',
           'STRING_ARRAY': 'String values are:', 'NOT_SET': 'Parameter not set.'}
_WAIT = 5.0  # seconds for a node's parameter services


def call(node: Any, node_name: str, method: str, *arguments: Any) -> Any:
    """
    Call a parameter service of a node and give its response.

    :param method: of :class:`rclpy.parameter_client.AsyncParameterClient`.
    :raises RuntimeError: if the services aren't there, or the call failed.
    """
    import rclpy
    from rclpy.parameter_client import AsyncParameterClient
    client = AsyncParameterClient(node, node_name)
    if not client.wait_for_services(timeout_sec=_WAIT):
        raise RuntimeError('Wait for service timed out waiting for parameter services for node '
                           f'{node_name}')
    future = getattr(client, method)(*arguments)
    rclpy.spin_until_future_complete(node, future)
    if future.result() is None:
        raise RuntimeError(
            f'Exception while calling service of node {node_name}: {future.exception()}')
    return future.result()


def _strategy(args: Any, name: str | None) -> NodeStrategy:
    """Discover until there is a node of that name; with None, all nodes."""
    if name is None:
        return NodeStrategy(args)
    return NodeStrategy(
        args, enough=lambda node: name in get_node_names(node, args.include_hidden_nodes))


class ListVerb(VerbExtension):
    """Output a list of available parameters."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        parser.add_argument('node_name', nargs='?', help='Name of the ROS node')
        parser.add_argument('--include-hidden-nodes', action='store_true',
                            help='Consider hidden nodes as well')

    def main(self, *, args: Any) -> Any:
        wanted = f"/{args.node_name.removeprefix('/')}" if args.node_name else None
        with _strategy(args, wanted) as strategy:
            names = get_node_names(strategy, args.include_hidden_nodes)
            if wanted is not None:
                if wanted not in names:
                    return 'Node not found'
                names = [wanted]
            for name in dict.fromkeys(names):
                try:
                    listed = call(strategy.node, name, 'list_parameters').result.names
                except RuntimeError as error:
                    print(error, file=sys.stderr)
                    continue
                if listed and not args.node_name:
                    print(f'{name}:')
                for parameter in sorted(listed):
                    print(f'  {parameter}')


class GetVerb(VerbExtension):
    """Get parameter."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        parser.add_argument('node_name', help='Name of the ROS node')
        parser.add_argument('--include-hidden-nodes', action='store_true',
                            help='Consider hidden nodes as well')
        parser.add_argument('parameter_name', help='Name of the parameter')

    def main(self, *, args: Any) -> Any:
        name = f"/{args.node_name.removeprefix('/')}"
        with _strategy(args, name) as strategy:
            if name not in get_node_names(strategy, args.include_hidden_nodes):
                return 'Node not found'
            return self.do(strategy.node, name, args)

    def do(self, node: Any, name: str, args: Any) -> Any:
        """Do it, now that the node is there."""
        from rclpy.parameter import Parameter, parameter_value_to_python
        values = call(node, name, 'get_parameters', [args.parameter_name]).values
        if not values:
            return 'Parameter not set'
        value = parameter_value_to_python(values[0])
        label = _LABELS[Parameter.Type(values[0].type).name]
        print(*[label] if value is None else [label, value])


class SetVerb(GetVerb):
    """Set parameter."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        super().add_arguments(parser, cli_name)
        parser.add_argument('value', help='Value of the parameter')

    def do(self, node: Any, name: str, args: Any) -> Any:
        from rcl_interfaces.msg import Parameter
        from rclpy.parameter import get_parameter_value
        parameter = Parameter(name=args.parameter_name, value=get_parameter_value(args.value))
        result = call(node, name, 'set_parameters', [parameter]).results[0]
        text = 'Set parameter successful' if result.successful else 'Setting parameter failed'
        print(f'{text}: {result.reason}' if result.reason else text,
              file=sys.stdout if result.successful else sys.stderr)
