# SPDX-License-Identifier: Apache-2.0
"""The services through which others read and set a node's parameters."""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING
import weakref

from rcl_interfaces import srv
from rclpy.exceptions import ParameterNotDeclaredException, ParameterUninitializedException
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_parameters

if TYPE_CHECKING:
    from rclpy.node import Node


class ParameterService:
    """Serves the parameters of a node."""

    def __init__(self, node: 'Node') -> None:
        self._reference = weakref.ref(node)
        for kind, name, callback in (
                (srv.DescribeParameters, 'describe_parameters', self._describe),
                (srv.GetParameters, 'get_parameters', self._get),
                (srv.GetParameterTypes, 'get_parameter_types', self._types),
                (srv.ListParameters, 'list_parameters', self._list),
                (srv.SetParameters, 'set_parameters', self._set),
                (srv.SetParametersAtomically, 'set_parameters_atomically', self._set_all)):
            node.create_service(kind, f'~/{name}', callback, qos_profile=qos_profile_parameters)

    def _node(self) -> 'Node':
        node = self._reference()
        if node is None:
            raise ReferenceError('Expected valid node weak reference')
        return node

    def _all(self, get: Callable[[str], Any], names: list[str]) -> list[Any]:
        """Get something for each name; what is unknown makes the whole answer empty."""
        try:
            return [get(name) for name in names]
        except (ParameterNotDeclaredException, ParameterUninitializedException):
            return []

    def _describe(self, request: Any, response: Any) -> Any:
        response.descriptors = self._all(self._node().describe_parameter, request.names)
        return response

    def _get(self, request: Any, response: Any) -> Any:
        found = self._all(self._node().get_parameter, request.names)
        response.values = [parameter.get_parameter_value() for parameter in found]
        return response

    def _types(self, request: Any, response: Any) -> Any:
        response.types = self._all(self._node().get_parameter_type, request.names)
        return response

    def _list(self, request: Any, response: Any) -> Any:
        response.result = self._node().list_parameters(request.prefixes, request.depth)
        return response

    def _result(self, messages: list[Any]) -> Any:
        from rcl_interfaces.msg import SetParametersResult
        try:
            return self._node().set_parameters_atomically(
                [Parameter.from_parameter_msg(message) for message in messages])
        except ParameterNotDeclaredException as error:
            return SetParametersResult(successful=False, reason=str(error))

    def _set(self, request: Any, response: Any) -> Any:
        response.results = [self._result([message]) for message in request.parameters]
        return response

    def _set_all(self, request: Any, response: Any) -> Any:
        response.result = self._result(request.parameters)
        return response
