# SPDX-License-Identifier: Apache-2.0
"""Verbs of ``ros2 service``."""
from __future__ import annotations

from typing import Any

from ros2cli.node import NODE_NAME_PREFIX
from ros2cli.node.direct import DirectNode
from ros2cli.verb import topic, VerbExtension


class ListVerb(topic.ListVerb):
    """Output a list of available services."""

    WHAT = 'service'


class CallVerb(VerbExtension):
    """Call a service."""

    def add_arguments(self, parser: Any, cli_name: str) -> None:
        add = parser.add_argument
        add('service_name', help="Name of the ROS service to call to (e.g. '/add_two_ints')")
        add('service_type', help="Type of the ROS service (e.g. 'std_srvs/srv/Empty')")
        add('values', nargs='?', default='{}',
            help="Values to fill the service request with in YAML format (e.g. '{a: 1, b: 2}')")

    def main(self, *, args: Any) -> Any:
        from rosidl_runtime_py.utilities import get_service
        try:
            kind = get_service(args.service_type)
        except (AttributeError, ModuleNotFoundError):
            raise RuntimeError('The passed service type is invalid') from None
        except ValueError:
            raise RuntimeError('The passed type is not a service') from None
        package, *_, name = args.service_type.split('/')
        with DirectNode(args, enough=lambda node: True, node_name=(
                f'{NODE_NAME_PREFIX}_requester_{package}_{name}')) as direct:
            return self._call(direct.node, kind, args)

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
            while not client.service_is_ready():
                rclpy.spin_once(node, timeout_sec=0.1)
        print(f'requester: making request: {request!r}\n')
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future)
        if future.result() is None:
            raise RuntimeError(f'Exception while calling service: {future.exception()!r}')
        print(f'response:\n{future.result()!r}\n')
        return None
