# SPDX-License-Identifier: Apache-2.0
"""Reads and sets the parameters of other nodes."""

from collections.abc import Callable
import time
from typing import Any

from rcl_interfaces import srv
from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_dict_from_yaml_file
from rclpy.qos import qos_profile_services_default, QoSProfile
from rclpy.task import Future

Done = Callable[[Future], None]


class AsyncParameterClient:
    """
    Calls the parameter services of a node.

    :param node: the node that calls.
    :param remote_node_name: the node whose parameters they are.
    """

    def __init__(self, node: Node, remote_node_name: str,
                 qos_profile: QoSProfile = qos_profile_services_default,
                 callback_group: CallbackGroup | None = None) -> None:
        def client(kind: Any, name: str) -> Client:
            return node.create_client(kind, f'{remote_node_name}/{name}', qos_profile=qos_profile,
                                      callback_group=callback_group)

        self.remote_node_name = remote_node_name
        self._get = client(srv.GetParameters, 'get_parameters')
        self._list = client(srv.ListParameters, 'list_parameters')
        self._set = client(srv.SetParameters, 'set_parameters')
        self._types = client(srv.GetParameterTypes, 'get_parameter_types')
        self._describe = client(srv.DescribeParameters, 'describe_parameters')
        self._set_all = client(srv.SetParametersAtomically, 'set_parameters_atomically')
        self._clients = [self._get, self._list, self._set, self._types, self._describe,
                         self._set_all]

    def services_are_ready(self) -> bool:
        """Say whether all services are there."""
        return all(client.service_is_ready() for client in self._clients)

    def wait_for_services(self, timeout_sec: float | None = None) -> bool:
        """Wait for all services, or for a number of seconds."""
        limit = None if timeout_sec is None else time.monotonic() + timeout_sec
        return all(client.wait_for_service(
            None if limit is None else max(limit - time.monotonic(), 0.0))
            for client in self._clients)

    @staticmethod
    def _call(client: Client, request: Any, callback: Done | None) -> Future:
        future = client.call_async(request)
        if callback is not None:
            future.add_done_callback(callback)
        return future

    def list_parameters(self, prefixes: list[str] | None = None, depth: int | None = None,
                        callback: Done | None = None) -> Future:
        """List names."""
        request = srv.ListParameters.Request(prefixes=prefixes or [])
        if depth is not None:
            request.depth = depth
        return self._call(self._list, request, callback)

    def get_parameters(self, names: list[str], callback: Done | None = None) -> Future:
        """Get values."""
        return self._call(self._get, srv.GetParameters.Request(names=names), callback)

    def get_parameter_types(self, names: list[str], callback: Done | None = None) -> Future:
        """Get types."""
        return self._call(self._types, srv.GetParameterTypes.Request(names=names), callback)

    def describe_parameters(self, names: list[str], callback: Done | None = None) -> Future:
        """Get descriptors."""
        return self._call(self._describe, srv.DescribeParameters.Request(names=names), callback)

    @staticmethod
    def _messages(parameters: list[Any]) -> list[Any]:
        return [parameter.to_parameter_msg() if isinstance(parameter, Parameter) else parameter
                for parameter in parameters]

    def set_parameters(self, parameters: list[Any], callback: Done | None = None) -> Future:
        """Set values one after the other."""
        request = srv.SetParameters.Request(parameters=self._messages(parameters))
        return self._call(self._set, request, callback)

    def set_parameters_atomically(self, parameters: list[Any],
                                  callback: Done | None = None) -> Future:
        """Set all values or none."""
        request = srv.SetParametersAtomically.Request(parameters=self._messages(parameters))
        return self._call(self._set_all, request, callback)

    def delete_parameters(self, names: list[str], callback: Done | None = None) -> Future:
        """Undeclare parameters."""
        return self.set_parameters([Parameter(name) for name in names], callback)

    def load_parameter_file(self, parameter_file: str, use_wildcard: bool = False,
                            callback: Done | None = None) -> Future:
        """Set what a parameter file holds for the node."""
        values = parameter_dict_from_yaml_file(parameter_file, use_wildcard)
        return self.set_parameters(list(values.values()), callback)
