# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 service``."""
from __future__ import annotations

import time
from typing import Any

from ros2cli.node import NODE_NAME_PREFIX
from ros2cli.node.strategy import add_arguments, NodeStrategy
from ros2cli.verb import VerbExtension


class ListVerb(VerbExtension):
    """Output a list of available services."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add_arguments(parser)
        parser.add_argument('-t', '--show-types', action='store_true',
                            help='Additionally show the service type')
        parser.add_argument('-c', '--count-services', action='store_true',
                            help='Only display the number of services discovered')
        parser.add_argument('--include-hidden-services', action='store_true',
                            help='Consider hidden services as well')

    def main(self, *, args: Any) -> Any:
        from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden
        with NodeStrategy(args) as node:
            services = [(name, types) for name, types in node.get_service_names_and_types()
                        if args.include_hidden_services or not topic_or_service_is_hidden(name)]
        if args.count_services:
            print(len(services))
            return
        for name, types in services:
            print(f"{name} [{', '.join(types)}]" if args.show_types else name)


class CallVerb(VerbExtension):
    """Call a service."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add = parser.add_argument
        add('service_name', help="Name of the ROS service to call to (e.g. '/add_two_ints')")
        add('service_type', help="Type of the ROS service (e.g. 'std_srvs/srv/Empty')")
        add('values', nargs='?', default='{}',
            help="Values to fill the service request with in YAML format (e.g. '{a: 1, b: 2}')")
        add('-r', '--rate', metavar='N', type=float,
            help='Repeat the call at a specific rate in Hz')

    def main(self, *, args: Any) -> Any:
        import rclpy
        from rosidl_runtime_py.utilities import get_service
        if args.rate is not None and args.rate <= 0:
            raise RuntimeError('rate must be greater than zero')
        try:
            kind = get_service(args.service_type)
        except (AttributeError, ModuleNotFoundError):
            raise RuntimeError('The passed service type is invalid') from None
        except ValueError:
            raise RuntimeError('The passed type is not a service') from None
        rclpy.init(args=[])
        package, _, name = kind._service.split('/')
        node = rclpy.create_node(f'{NODE_NAME_PREFIX}_requester_{package}_{name}')
        try:
            return self._call(node, kind, args)
        finally:
            node.destroy_node()
            rclpy.try_shutdown()

    def _call(self, node: Any, kind: Any, args: Any) -> str | None:
        import rclpy
        from rosidl_runtime_py import set_message_fields
        import yaml
        client = node.create_client(kind, args.service_name)
        request = kind.Request()
        try:
            set_message_fields(request, yaml.safe_load(args.values))
        except (AssertionError, AttributeError, TypeError, ValueError) as error:
            return f'Failed to populate field: {error}'
        if not client.service_is_ready():
            print('waiting for service to become available...')
            client.wait_for_service()
        while True:
            print(f'requester: making request: {request!r}\n')
            started = time.monotonic()
            future = client.call_async(request)
            rclpy.spin_until_future_complete(node, future)
            if future.result() is None:
                raise RuntimeError(
                    f'Exception while calling service: {future.exception()!r}')
            print(f'response:\n{future.result()!r}\n')
            if args.rate is None or not rclpy.ok():
                return None
            time.sleep(max(started + 1.0 / args.rate - time.monotonic(), 0.0))
