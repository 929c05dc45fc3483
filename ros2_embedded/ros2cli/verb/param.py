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


class ListVerb(VerbExtension):
    """Output a list of available parameters."""

    NODES: str | None = '?'

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        parser.add_argument('node_name', nargs=self.NODES, help='Name of the ROS node')
        parser.add_argument('--include-hidden-nodes', action='store_true',
                            help='Consider hidden nodes as well')

    def main(self, *, args: Any) -> Any:
        if not args.node_name:
            with NodeStrategy(args) as strategy:
                for name in dict.fromkeys(get_node_names(strategy, args.include_hidden_nodes)):
                    print(f'{name}:')
                    self.do(strategy.node, name, args)
            return None
        name = f"/{args.node_name.removeprefix('/')}"

        def exists(node: Any) -> bool:
            return name in get_node_names(node, args.include_hidden_nodes)

        with NodeStrategy(args, enough=exists) as strategy:
            return self.do(strategy.node, name, args) if exists(strategy) else 'Node not found'

    def do(self, node: Any, name: str, args: Any) -> Any:
        """Do it with a node that exists."""
        try:
            listed = call(node, name, 'list_parameters').result.names
        except RuntimeError as error:
            print(error, file=sys.stderr)
        else:
            print(*(f'  {parameter}' for parameter in sorted(listed)), sep='\n')


class GetVerb(ListVerb):
    """Get parameter."""

    NODES = None

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        super().add_arguments(parser, cli_name)
        parser.add_argument('parameter_name', help='Name of the parameter')

    def do(self, node: Any, name: str, args: Any) -> Any:
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
