# SPDX-License-Identifier: Apache-2.0
"""
Get and set the parameters of the graph's nodes for viewers.

A viewer names a parameter ``/NODE.PARAMETER``. The node that has it checks a new value; this
module checks its type, which JSON does not tell.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from foxglove import Parameter
from rcl_interfaces import msg, srv
from rclpy.parameter import Parameter as NodeParameter
from rclpy.parameter import parameter_value_to_python

from fogros2_monitor.services import Services

#: Largest number of parameters that a viewer gets or sets at once.
MOST = 5000
#: Time-out of the nodes' answers to a viewer, in seconds.
ANSWER = 2.0
_Type = NodeParameter.Type
_TYPES = {kind.value for kind in _Type} - {_Type.NOT_SET.value}


def shown(values: Mapping[str, msg.ParameterValue]) -> list[Parameter]:
    """Return parameters as viewers see them, without those that have no value."""
    natives: dict[str, Any] = {
        name: parameter_value_to_python(value) if value.type != _Type.BYTE_ARRAY.value
        else b''.join(value.byte_array_value)
        for name, value in values.items() if value.type in _TYPES}
    return [Parameter(name, value=native) for name, native in natives.items()]


def converted(parameter: Parameter, like: msg.ParameterValue) -> msg.Parameter:
    """
    Return a viewer's parameter as its node takes it.

    :param like: the present value, which tells the type.
    :raises ValueError: the new value is of another type.
    """
    value: Any = parameter.get_value()
    kind = _Type(like.type)
    if kind is _Type.NOT_SET:
        raise ValueError('there is no such parameter')
    # JSON has one type for both kinds of numbers
    if kind is _Type.DOUBLE and type(value) is int:
        value = float(value)
    if kind is _Type.DOUBLE_ARRAY and isinstance(value, list):
        value = [float(item) if type(item) is int else item for item in value]
    if kind is _Type.BYTE_ARRAY and isinstance(value, bytes):
        value = [bytes([byte]) for byte in value]
    return NodeParameter(parameter.name.partition('.')[2], kind, value).to_parameter_msg()


class Parameters:
    """
    The parameters of all nodes.

    :param services: calls the nodes.
    :param admits: whether viewers may see a parameter, by its name.
    :param report: sends an error to the viewers.
    """

    def __init__(self, services: Services, admits: Callable[[str], bool],
                 report: Callable[[str], None]) -> None:
        self._services, self._admits, self._report = services, admits, report

    def get(self, names: Sequence[str], nodes: Collection[str]) -> dict[str, msg.ParameterValue]:
        """Return the values of nodes' parameters by their names; all for no names."""
        listed = {} if names else self._call(
            'list_parameters', srv.ListParameters, {node: {} for node in nodes})
        names = [*names, *(f'{node}.{key}' for node, answer in listed.items()
                           for key in answer.result.names)]
        if len(names) > MOST:
            self._report(f'only {MOST} of {len(names)} parameters are shown or set')
        keys: dict[str, list[str]] = {}
        for node, _, key in (name.partition('.') for name in names[:MOST] if self._admits(name)):
            if node in nodes:
                keys.setdefault(node, []).append(key)
        answers = self._call('get_parameters', srv.GetParameters, {
            node: {'names': each} for node, each in keys.items()})
        return {f'{node}.{key}': value for node, answer in answers.items()
                for key, value in zip(keys[node], answer.values)}

    def set(self, parameters: Sequence[Parameter], nodes: Collection[str]) -> None:
        """Have nodes set parameters."""
        known = self.get([parameter.name for parameter in parameters], nodes)
        tasks, problems = dict[str, list[msg.Parameter]](), list[str]()
        for parameter in parameters[:MOST]:
            try:
                task = converted(parameter, known.get(parameter.name, msg.ParameterValue()))
                tasks.setdefault(parameter.name.partition('.')[0], []).append(task)
            except ValueError:
                problems.append(f'{parameter.name} is unknown, or of another type')
        answers = self._call('set_parameters', srv.SetParameters, {
            node: {'parameters': each} for node, each in tasks.items()})
        problems += [f'{node} did not answer' for node in tasks.keys() - answers.keys()]
        problems += [f'{node}.{task.name} is not set: {result.reason}'
                     for node, answer in answers.items()
                     for task, result in zip(tasks[node], answer.results) if not result.successful]
        if problems:
            self._report('; '.join(problems))

    def _call(self, verb: str, cls: Any, requests: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
        answers = self._services.call({f'{node}/{verb}': (cls, cls.Request(**request))
                                       for node, request in requests.items()}, ANSWER)
        return {name.removesuffix(f'/{verb}'): answer for name, answer in answers.items()}
