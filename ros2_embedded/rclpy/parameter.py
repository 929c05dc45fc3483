# SPDX-License-Identifier: Apache-2.0
"""Parameters."""

import array
from enum import Enum
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.msg import ParameterType, ParameterValue
from rclpy._arguments import flatten

PARAMETER_SEPARATOR_STRING = '.'

_SEQUENCES = (list, tuple, array.array)


class Parameter:
    """
    A name, a type and a value.

    :raises TypeError: if no type is given and none fits the value.
    :raises ValueError: if type and value don't agree.
    """

    class Type(Enum):
        """As in rcl_interfaces/msg/ParameterType."""

        NOT_SET = ParameterType.PARAMETER_NOT_SET
        BOOL = ParameterType.PARAMETER_BOOL
        INTEGER = ParameterType.PARAMETER_INTEGER
        DOUBLE = ParameterType.PARAMETER_DOUBLE
        STRING = ParameterType.PARAMETER_STRING
        BYTE_ARRAY = ParameterType.PARAMETER_BYTE_ARRAY
        BOOL_ARRAY = ParameterType.PARAMETER_BOOL_ARRAY
        INTEGER_ARRAY = ParameterType.PARAMETER_INTEGER_ARRAY
        DOUBLE_ARRAY = ParameterType.PARAMETER_DOUBLE_ARRAY
        STRING_ARRAY = ParameterType.PARAMETER_STRING_ARRAY

        @classmethod
        def from_parameter_value(cls, parameter_value: Any) -> 'Parameter.Type':
            """
            Find the type of a value.

            :raises TypeError: if no parameter can have it.
            """
            if parameter_value is None:
                return cls.NOT_SET
            for kind, single in _SCALARS.items():
                if isinstance(parameter_value, single):
                    return cls[kind]
            if isinstance(parameter_value, _SEQUENCES):
                for kind, single in (('BYTE', bytes), *_SCALARS.items()):
                    if all(isinstance(item, single) for item in parameter_value):
                        return cls[f'{kind}_ARRAY']
                raise TypeError('The given value is not a list of one of the allowed types'
                                f" '{parameter_value}'.")
            raise TypeError(
                f"The given value is not one of the allowed types '{parameter_value}'.")

        def check(self, parameter_value: Any) -> bool:
            """Say whether a value has this type."""
            if self is Parameter.Type.NOT_SET:
                return parameter_value is None
            kind, _, many = self.name.partition('_')
            if not many:
                return isinstance(parameter_value, _SCALARS[kind])
            allowed = _SEQUENCES if kind in ('INTEGER', 'DOUBLE') else (list, tuple)
            single: Any = bytes if kind == 'BYTE' else _SCALARS[kind]
            return isinstance(parameter_value, allowed) and all(
                isinstance(item, single) and (kind != 'BYTE' or len(item) == 1)
                for item in parameter_value)

    def __init__(self, name: str, type_: 'Parameter.Type | None' = None,
                 value: Any = None) -> None:
        if type_ is None:
            type_ = Parameter.Type.from_parameter_value(value)
        if not isinstance(type_, Parameter.Type):
            raise TypeError(f"type must be an instance of '{Parameter.Type!r}'")
        if not type_.check(value):
            raise ValueError(f"Type '{type_}' and value '{value}' do not agree")
        self._type_, self._name, self._value = type_, name, value

    @property
    def name(self) -> str:
        """Its name."""
        return self._name

    @property
    def type_(self) -> 'Parameter.Type':
        """Its type."""
        return self._type_

    @property
    def value(self) -> Any:
        """Its value."""
        return self._value

    def get_parameter_value(self) -> Any:
        """Convert type and value to ``rcl_interfaces.msg.ParameterValue``."""
        message = ParameterValue(type=self.type_.value)
        if self.type_ is not Parameter.Type.NOT_SET:
            setattr(message, f'{self.type_.name.lower()}_value', self.value)
        return message

    def to_parameter_msg(self) -> Any:
        """Convert to ``rcl_interfaces.msg.Parameter``."""
        return ParameterMsg(name=self.name, value=self.get_parameter_value())

    @classmethod
    def from_parameter_msg(cls, param_msg: Any) -> 'Parameter':
        """Convert from ``rcl_interfaces.msg.Parameter``."""
        kind = Parameter.Type(param_msg.value.type)
        value = None
        if kind is not Parameter.Type.NOT_SET:
            value = getattr(param_msg.value, f'{kind.name.lower()}_value')
        return cls(param_msg.name, kind, value)


# bool comes first: it is an int, too
_SCALARS: dict[str, type] = {'BOOL': bool, 'INTEGER': int, 'DOUBLE': float, 'STRING': str}


def get_parameter_value(string_value: str) -> Any:
    """Guess type and value from text as one types it, as YAML."""
    import yaml
    try:
        value = yaml.safe_load(string_value)
    except yaml.YAMLError:
        value = string_value
    if value is None or isinstance(value, dict):
        value = string_value
    try:
        return Parameter('', value=value).get_parameter_value()
    except TypeError:  # mixed lists, dates
        return Parameter('', value=string_value).get_parameter_value()


def parameter_value_to_python(parameter_value: Any) -> Any:
    """
    Give the value of ``rcl_interfaces.msg.ParameterValue``.

    :raises RuntimeError: if its type is unknown.
    """
    try:
        kind = Parameter.Type(parameter_value.type)
    except ValueError:
        raise RuntimeError(f'unexpected parameter type {parameter_value.type}') from None
    if kind is Parameter.Type.NOT_SET:
        return None
    value = getattr(parameter_value, f'{kind.name.lower()}_value')
    return list(value) if kind.name.endswith('ARRAY') else value


def parameter_dict_from_yaml_file(
        parameter_file: str, use_wildcard: bool = False) -> dict[str, Any]:
    """
    Read ``rcl_interfaces.msg.Parameter`` messages from a parameter file, by their names.

    :param use_wildcard: take those of ``/**``, too.
    :raises RuntimeError: if it is no parameter file, or has nothing to take.
    """
    import yaml
    with open(parameter_file, encoding='utf-8') as file:
        content = yaml.safe_load(file)
    keys = sorted((key for key in content if use_wildcard or key != '/**'),
                  key=lambda key: bool(key != '/**'))  # those for all nodes count least
    if not keys:
        raise RuntimeError('Param file does not contain selected parameters')
    values: dict[str, Any] = {}
    for key in keys:
        if not isinstance(content[key], dict) or 'ros__parameters' not in content[key]:
            raise RuntimeError(f'YAML file is not a valid ROS parameter file for node {key}')
        values.update(content[key]['ros__parameters'])
    return {name: ParameterMsg(name=name, value=get_parameter_value(str(value)))
            for name, value in flatten(values)}
