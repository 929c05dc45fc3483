# SPDX-License-Identifier: Apache-2.0
"""
Parameters of nodes: normalized, evaluated, and as rclpy's.

Normalized ones have flat names. A plain text stays a text whatever it looks like; what
substitutions become is read as rcl reads YAML.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import os
import pathlib
import re
from typing import Any, Iterator

from launch import SomeSubstitutionsType_types_tuple, Substitution
from launch.launch_context import LaunchContext
from launch.substitutions import TextSubstitution
from launch.utilities import ensure_argument_type, perform_substitutions
from launch.utilities import normalize_to_list_of_substitutions as normalize
from launch.utilities.ros_yaml import dump, load
from launch.utilities.type_utils import is_substitution

from ..parameter_descriptions import ParameterFile, ParameterValue

#: By tuples of substitutions.
ParametersDict = dict[tuple[Any, ...], Any]

_SCALARS = (bool, int, float, str)
_WRAP = ('If the parameter is meant to be a string, try wrapping it in '
         'launch_ros.parameter_descriptions.ParameterValue(value, value_type=str)')


def as_argument(value: Any) -> str:
    """
    Return a parameter's value for ``-p``, where rcl finds its type.

    A text that launch too takes for another type is written as in ROS 2.
    """
    import yaml
    if isinstance(value, str):
        with contextlib.suppress(yaml.YAMLError):
            if load(value) == value or isinstance(yaml.safe_load(value), (int, float, list)):
                return value
    return dump(value)


def _normalize_array(value: Sequence[Any]) -> tuple[Any, ...]:
    value = [os.fspath(item) if isinstance(item, os.PathLike) else item for item in value]
    for item in value:
        ensure_argument_type(
            item, (float, int, str, bool, *SomeSubstitutionsType_types_tuple), 'subvalue')
    if is_substitution(value):
        # One text made of several pieces, not an array.
        return tuple(normalize(value))
    if {type(item) for item in value} == {int, float}:
        return tuple(float(item) for item in value)
    return tuple(item if isinstance(item, _SCALARS) else normalize(item) for item in value)


def normalize_parameter_dict(
    parameters: Mapping[Any, Any], *, _prefix: Sequence[Substitution] | None = None
) -> ParametersDict:
    """
    Return the dictionary with names of nested ones joined by dots.

    :raises TypeError: for values that can't be parameters.
    """
    normalized: dict[Any, Any] = {}
    for given_name, value in parameters.items():
        parts = normalize(given_name)
        if _prefix:
            parts = [*_prefix, TextSubstitution(text='.'), *parts]
        name = tuple(parts)
        if isinstance(value, Mapping):
            normalized.update(normalize_parameter_dict(value, _prefix=name))
        elif isinstance(value, (str, os.PathLike)):
            normalized[name] = os.fspath(value)
        elif isinstance(value, Substitution):
            normalized[name] = (value,)
        elif isinstance(value, (ParameterValue, float, bool, int, bytes)):
            normalized[name] = value
        elif isinstance(value, Sequence):
            normalized[name] = _normalize_array(value)
        else:
            raise TypeError(f'Unexpected type for parameter value {value!r}')
    return normalized


def normalize_parameters(parameters: Sequence[Any]) -> Sequence[Any]:
    """
    Return the dictionaries normalized, and all else as files.

    :raises TypeError: for anything but a sequence.
    """
    if isinstance(parameters, str) or not isinstance(parameters, Sequence):
        raise TypeError(f'Expecting list of parameters, got {parameters}')
    normalized: list[Any] = []
    for parameter in parameters:
        if isinstance(parameter, Mapping):
            normalized.append(normalize_parameter_dict(parameter))
        elif isinstance(parameter, ParameterFile):
            normalized.append(parameter)
        else:
            normalized.append(ParameterFile(parameter))
    return tuple(normalized)


def _uniform(name: str, items: Sequence[Any]) -> Any:
    kind = type(items[0]) if items else None
    if kind not in _SCALARS or not all(isinstance(i, kind) for i in items):
        raise TypeError(
            'Expected a non-empty sequence, with items of uniform type. Allowed sequence item '
            f'types are bool, int, float, str. Got inconsistent input for "{name}"')
    return tuple(items)


def _from_text(name: str, text: str) -> Any:
    import yaml
    try:
        value = load(text or "''")
    except yaml.YAMLError as exc:
        raise TypeError(
            f'Unable to parse the value of parameter {name} as yaml. {_WRAP}') from exc
    if type(value) in (*_SCALARS, bytes):
        return value
    if not isinstance(value, Sequence):
        raise TypeError(
            'Allowed value types are bytes, bool, int, float, str, Sequence[bool], '
            'Sequence[int], Sequence[float], Sequence[str]. '
            f'Got {type(value)} for "{name}". {_WRAP}')
    return _uniform(name, value)


def _evaluate(context: LaunchContext, name: str, value: Any) -> Any:
    if isinstance(value, ParameterValue):
        return value.evaluate(context)
    if not isinstance(value, tuple):
        return value
    if value and isinstance(value[0], Substitution):
        return _from_text(name, perform_substitutions(context, value))
    return _uniform(name, [
        load(perform_substitutions(context, item)) if isinstance(item, list) else item
        for item in value])


def evaluate_parameter_dict(
    context: LaunchContext, parameters: ParametersDict
) -> dict[str, Any]:
    """
    Return the values by name; what substitutions become is read as YAML.

    :raises TypeError: for what becomes nothing a parameter can be.
    """
    evaluated = {}
    for substitutions, value in parameters.items():
        name = perform_substitutions(context, substitutions)
        evaluated[name] = _evaluate(context, name, value)
    return evaluated


def evaluate_parameters(context: LaunchContext, parameters: Sequence[Any]) -> Sequence[Any]:
    """Return dictionaries by value and files by path."""
    return tuple(
        parameter.evaluate(context) if isinstance(parameter, ParameterFile)
        else evaluate_parameter_dict(context, parameter) for parameter in parameters)


def _nodes_of(content: dict[str, Any], names: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if key == 'ros__parameters':
            yield '/'.join(names), value
        elif isinstance(value, dict):
            yield from _nodes_of(value, (*names, key.strip('/')))


def _matches(pattern: str, node: str) -> bool:
    """Say whether a key of a parameter file means a node: * is one part of its name, ** any."""
    parts = [{'*': '/[^/]+', '**': '(/[^/]+)*'}.get(part, '/' + re.escape(part))
             for part in pattern.split('/') if part]
    return re.fullmatch(''.join(parts), f'/{node}') is not None


def _read(path: pathlib.Path, node: str) -> list[dict[str, Any]]:
    """Return the parts of a parameter file that are for a node; a later part wins, as in rcl."""
    content = load(path.read_text('utf-8')) or {}
    nodes = list(_nodes_of(content))
    return [values or {} for pattern, values in nodes if _matches(pattern, node)] if nodes else [
        content]


def to_parameters_list(
    context: LaunchContext, node_name: str, namespace: str | None,
    evaluated_parameters: Sequence[Any]
) -> list[Any]:
    """
    Return the node's parameters; of files, what stands there for all nodes or this one.

    :raises RuntimeError: for values that can't be parameters.
    """
    from rclpy.parameter import Parameter
    node = '/'.join(part.strip('/') for part in (namespace or '', node_name) if part.strip('/'))
    parameters = []
    for given in evaluated_parameters:
        values: dict[str, Any] = {}
        for part in [given] if isinstance(given, dict) else _read(given, node):
            values |= part if part is given else evaluate_parameter_dict(
                context, normalize_parameter_dict(part))
        for name, value in values.items():
            kind = next((kind for kind in Parameter.Type if kind.check(value)), None)
            if kind is None:
                raise RuntimeError(f'invalid parameter value {value!r}')
            parameters.append(Parameter(name, kind, value))
    return parameters
