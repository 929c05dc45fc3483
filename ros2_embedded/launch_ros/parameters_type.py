# SPDX-License-Identifier: Apache-2.0
"""What is accepted as parameters of a node, and what becomes of that."""
import pathlib
from typing import Any, Dict, Mapping, Sequence, Tuple, Union

from launch import SomeSubstitutionsType, SomeSubstitutionsType_types_tuple, Substitution

from .parameter_descriptions import Parameter as ParameterDescription
from .parameter_descriptions import ParameterFile
from .parameter_descriptions import ParameterValue as ParameterValueDescription

_SingleValueType = Union[str, int, float, bool]
_MultiValueType = Union[Sequence[str], Sequence[int], Sequence[float], Sequence[bool], bytes]

SomeParameterFile = Union[SomeSubstitutionsType, pathlib.Path, ParameterFile]
SomeParameterName = SomeSubstitutionsType
SomeParameterValue = Union[
    ParameterValueDescription, SomeSubstitutionsType, Sequence[SomeSubstitutionsType],
    _SingleValueType, _MultiValueType]
SomeParameterValue_types_tuple = (
    SomeSubstitutionsType_types_tuple + (str, int, float, bool, bytes))
SomeParametersDict = Mapping[Any, Any]
SomeParameters = Sequence[Union[SomeParameterFile, ParameterDescription, SomeParametersDict]]

ParameterName = Tuple[Substitution, ...]
ParameterValue = Union[
    Sequence[Substitution], Sequence[Sequence[Substitution]], _SingleValueType, _MultiValueType,
    ParameterValueDescription]
ParametersDict = Dict[ParameterName, ParameterValue]
Parameters = Sequence[Union[ParameterFile, ParametersDict, ParameterDescription]]

EvaluatedParameterValue = Union[_SingleValueType, _MultiValueType]
EvaluatedParameters = Sequence[
    Union[pathlib.Path, ParameterDescription, Dict[str, EvaluatedParameterValue]]]
