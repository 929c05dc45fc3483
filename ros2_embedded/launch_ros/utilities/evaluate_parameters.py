# SPDX-License-Identifier: Apache-2.0
"""The values of normalized parameters in a launch's context."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from launch import Substitution
from launch.launch_context import LaunchContext
from launch.utilities import ensure_argument_type, perform_substitutions

from ..parameter_descriptions import Parameter, ParameterFile, ParameterValue
from ..parameters_type import EvaluatedParameters, Parameters, ParametersDict

_WRAP = ('If the parameter is meant to be a string, try wrapping it in '
         'launch_ros.parameter_descriptions.ParameterValue(value, value_type=str)')


def _uniform(name: str, items: Sequence[Any]) -> Any:
    kind = type(items[0]) if items else None
    if kind not in (bool, int, float, str) or not all(isinstance(i, kind) for i in items):
        raise TypeError(
            'Expected a non-empty sequence, with items of uniform type. Allowed sequence item '
            f'types are bool, int, float, str. Got inconsistent input for "{name}"')
    return tuple(items)


def _from_text(name: str, text: str) -> Any:
    import yaml
    try:
        value = yaml.safe_load(text or "''")
    except yaml.YAMLError as exc:
        raise TypeError(
            f'Unable to parse the value of parameter {name} as yaml. {_WRAP}') from exc
    if type(value) in (bool, int, float, str, bytes):
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
    if not isinstance(value, tuple) or not value:
        ensure_argument_type(value, (float, int, str, bool, bytes), 'value')
        return value
    if isinstance(value[0], Substitution):
        return _from_text(name, perform_substitutions(context, value))
    if isinstance(value[0], Sequence):
        import yaml
        return _uniform(
            name, [yaml.safe_load(perform_substitutions(context, item)) for item in value])
    return value


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


def evaluate_parameters(context: LaunchContext, parameters: Parameters) -> EvaluatedParameters:
    """Return dictionaries by value and files by path; single parameters stay as they are."""
    evaluated: list[Any] = []
    for parameter in parameters:
        if isinstance(parameter, ParameterFile):
            evaluated.append(parameter.evaluate(context))
        elif isinstance(parameter, Parameter):
            evaluated.append(parameter)
        elif isinstance(parameter, dict):
            evaluated.append(evaluate_parameter_dict(context, parameter))
    return tuple(evaluated)
