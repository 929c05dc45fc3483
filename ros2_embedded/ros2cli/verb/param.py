# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 param``."""

import re
import sys
from typing import Any

from ros2cli.node.strategy import add_arguments, NodeStrategy
from ros2cli.verb import VerbExtension
from ros2cli.verb.node import (
    get_absolute_node_name,
    get_node_names,
    wait_for_node,
)

_LABELS = {'BOOL': 'Boolean value is:', 'INTEGER': 'Integer value is:',
           'DOUBLE': 'Double value is:', 'STRING': 'String value is:',
           'BYTE_ARRAY': 'Byte values are:', 'BOOL_ARRAY': 'Boolean values are:',
           'INTEGER_ARRAY': 'Integer values are:', 'DOUBLE_ARRAY': 'Double values are:',
           'STRING_ARRAY': 'String values are:', 'NOT_SET': 'Parameter not set.'}
_WAIT = 5.0  # seconds for a node's parameter services


def _add_node_arguments(parser: Any) -> None:
    add_arguments(parser)
    parser.add_argument('node_name', help='Name of the ROS node')
    parser.add_argument('--include-hidden-nodes', action='store_true',
                        help='Consider hidden nodes as well')
    parser.add_argument(
        '--timeout', metavar='N', type=int, default=1,
        help='Wait for N seconds until node becomes available (default %(default)s sec)')


def _type_text(number: int) -> str:
    from rclpy.parameter import Parameter
    name = Parameter.Type(number).name.lower().replace('_', ' ')
    return name.replace('bool', 'boolean')


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


class _OneNodeVerb(VerbExtension):
    """A verb for one node's parameters."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        _add_node_arguments(parser)

    def main(self, *, args: Any) -> Any:
        name = get_absolute_node_name(args.node_name)
        with NodeStrategy(args) as node:
            if not wait_for_node(node, name, args.include_hidden_nodes, args.timeout):
                return 'Node not found'
            return self.do(node.node, name, args)

    def do(self, node: Any, name: str, args: Any) -> Any:
        """Do it, now that the node is there."""
        raise NotImplementedError()


class ListVerb(VerbExtension):
    """Output a list of available parameters."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        parser.add_argument('node_name', nargs='?', help='Name of the ROS node')
        parser.add_argument(
            '--filter', nargs=1,
            help='Only parameters matching the regex expression will be showed. Supports `re` '
                 'regex syntax.')
        parser.add_argument('--include-hidden-nodes', action='store_true',
                            help='Consider hidden nodes as well')
        parser.add_argument('--param-prefixes', nargs='+', default=[],
                            help='Only list parameters with the provided prefixes')
        parser.add_argument('--param-type', action='store_true',
                            help='Print parameter types with parameter names')

    def main(self, *, args: Any) -> Any:
        with NodeStrategy(args) as strategy:
            node = strategy.node
            names = sorted({name.full_name for name in get_node_names(
                node=node, include_hidden_nodes=args.include_hidden_nodes)})
            if args.node_name:
                wanted = get_absolute_node_name(args.node_name)
                if wanted not in names:
                    return 'Node not found'
                names = [wanted]
            for name in names:
                try:
                    self._list(node, name, args)
                except RuntimeError as error:
                    print(error, file=sys.stderr)

    def _list(self, node: Any, name: str, args: Any) -> None:
        listed = sorted(call(node, name, 'list_parameters', args.param_prefixes).result.names)
        if args.filter is not None:
            listed = [one for one in listed if re.match(args.filter[0], one)]
        if not args.node_name and listed:
            print(f'{name}:')
        types = {}
        if args.param_type:
            types = {one.name: _type_text(one.type)
                     for one in call(node, name, 'describe_parameters', listed).descriptors}
        for one in listed:
            print(f'  {one} (type: {types[one]})' if args.param_type else f'  {one}')


class GetVerb(_OneNodeVerb):
    """Get parameter."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        _add_node_arguments(parser)
        parser.add_argument('parameter_name', help='Name of the parameter')
        parser.add_argument('--hide-type', action='store_true', help='Hide the type information')

    def do(self, node: Any, name: str, args: Any) -> Any:
        from rclpy.parameter import Parameter, parameter_value_to_python
        values = call(node, name, 'get_parameters', [args.parameter_name]).values
        if not values:
            return 'Parameter not set'
        value = parameter_value_to_python(values[0])
        label = _LABELS[Parameter.Type(values[0].type).name]
        if args.hide_type:
            print(value)
        else:
            print(*([label] if value is None else [label, value]))


class SetVerb(_OneNodeVerb):
    """Set parameter."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        _add_node_arguments(parser)
        parser.add_argument('parameter_name', help='Name of the parameter')
        parser.add_argument('value', help='Value of the parameter')

    def do(self, node: Any, name: str, args: Any) -> Any:
        from rcl_interfaces.msg import Parameter
        from rclpy.parameter import get_parameter_value
        parameter = Parameter(name=args.parameter_name, value=get_parameter_value(args.value))
        result = call(node, name, 'set_parameters', [parameter]).results[0]
        text = 'Set parameter successful' if result.successful else 'Setting parameter failed'
        print(f'{text}: {result.reason}' if result.reason else text,
              file=sys.stdout if result.successful else sys.stderr)
