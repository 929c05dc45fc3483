# SPDX-License-Identifier: Apache-2.0
"""
Parameters in one form: flat names, texts as substitutions.

A plain text stays a text whatever it looks like, so it is quoted as YAML does: what
substitutions become is read as YAML, see :mod:`launch_ros.utilities.evaluate_parameters`.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from launch import SomeSubstitutionsType_types_tuple, Substitution
from launch.substitutions import TextSubstitution
from launch.utilities import ensure_argument_type, normalize_to_list_of_substitutions

from ..parameter_descriptions import Parameter, ParameterFile, ParameterValue
from ..parameters_type import Parameters, ParametersDict, SomeParameters, SomeParametersDict


def as_yaml(value: Any) -> str:
    import yaml
    return str(yaml.dump(value))


def _normalize_array(value: Sequence[Any]) -> tuple[Any, ...]:
    kinds = set()
    for item in value:
        ensure_argument_type(
            item, (float, int, str, bool, *SomeSubstitutionsType_types_tuple), 'subvalue')
        kinds.add(next(
            kind for kind in (Substitution, str, bool, int, float, object)
            if isinstance(item, kind)))
    if kinds in ({int}, {bool}):
        return tuple(value)
    if kinds and kinds <= {int, float}:
        return tuple(float(item) for item in value)
    if Substitution in kinds and kinds <= {str, Substitution}:
        # One text made of several pieces, not an array.
        return tuple(normalize_to_list_of_substitutions(value))
    return tuple(
        normalize_to_list_of_substitutions(
            as_yaml(item) if isinstance(item, (float, int, bool, str)) else item)
        for item in value)


def normalize_parameter_dict(
    parameters: SomeParametersDict, *, _prefix: Sequence[Substitution] | None = None
) -> ParametersDict:
    """
    Return the dictionary with names of nested ones joined by dots.

    :raises TypeError: for values that can't be parameters.
    """
    normalized: dict[Any, Any] = {}
    for given_name, value in parameters.items():
        parts = normalize_to_list_of_substitutions(given_name)
        if _prefix:
            parts = [*_prefix, TextSubstitution(text='.'), *parts]
        name = tuple(parts)
        if isinstance(value, Mapping):
            normalized.update(normalize_parameter_dict(value, _prefix=name))
        elif isinstance(value, str):
            normalized[name] = tuple(normalize_to_list_of_substitutions(as_yaml(value)))
        elif isinstance(value, Substitution):
            normalized[name] = (value,)
        elif isinstance(value, (ParameterValue, float, bool, int, bytes)):
            normalized[name] = value
        elif isinstance(value, Sequence):
            normalized[name] = _normalize_array(value)
        else:
            raise TypeError(f'Unexpected type for parameter value {value!r}')
    return normalized


def normalize_parameters(parameters: SomeParameters) -> Parameters:
    """
    Return the dictionaries normalized, and what is neither them nor a parameter as files.

    :raises TypeError: for anything but a sequence.
    """
    if isinstance(parameters, str) or not isinstance(parameters, Sequence):
        raise TypeError(f'Expecting list of parameters, got {parameters}')
    normalized: list[Any] = []
    for parameter in parameters:
        if isinstance(parameter, Mapping):
            normalized.append(normalize_parameter_dict(parameter))
        elif isinstance(parameter, (Parameter, ParameterFile)):
            normalized.append(parameter)
        else:
            normalized.append(ParameterFile(parameter))
    return tuple(normalized)
