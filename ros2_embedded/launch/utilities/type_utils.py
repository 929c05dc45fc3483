# SPDX-License-Identifier: Apache-2.0
"""Values that are scalars, uniform lists, or substitutions that become either."""
from __future__ import annotations

import collections.abc
from typing import Any, cast, List, Optional, Sequence, Set, Tuple, Type, TYPE_CHECKING, Union

from ..some_substitutions_type import SomeSubstitutionsType
from ..substitution import Substitution
from . import ensure_argument_type, normalize_to_list_of_substitutions, perform_substitutions

if TYPE_CHECKING:
    from ..launch_context import LaunchContext

ScalarTypesTuple = (int, float, bool, str)
ListTypesTuple = (List[int], List[float], List[bool], List[str])
AllowedTypesTuple = ScalarTypesTuple + ListTypesTuple

ScalarTypesType = Type[Union[int, float, bool, str]]
ListTypesType = Type[Union[List[int], List[float], List[bool], List[str]]]
AllowedTypesType = Union[ScalarTypesType, ListTypesType]
ScalarValueType = Union[int, float, bool, str]
ListValueType = Union[List[int], List[float], List[bool], List[str]]
SequenceValueType = Union[Sequence[int], Sequence[float], Sequence[bool], Sequence[str]]
AllowedValueType = Union[ScalarValueType, SequenceValueType]
SomeScalarType = Union[SomeSubstitutionsType, ScalarValueType]
SomeSequenceType = Sequence[Union[int, float, bool, str, SomeSubstitutionsType]]
SomeValueType = Union[SomeScalarType, SomeSequenceType]
NormalizedScalarType = Union[List[Substitution], ScalarValueType]
NormalizedSequenceType = Sequence[Union[int, float, bool, str, List[Substitution]]]
NormalizedValueType = Union[NormalizedScalarType, NormalizedSequenceType]
StrSomeScalarType = SomeScalarType
StrSomeSequenceType = Sequence[Union[int, float, bool, str]]
StrSomeValueType = Union[StrSomeScalarType, StrSomeSequenceType]


def is_typing_list(data_type: Any) -> bool:
    """Say whether it is ``List``, bare or of something."""
    return data_type is List or getattr(data_type, '__origin__', None) is list


def is_valid_scalar_type(data_type: Any) -> bool:
    """Say whether it is int, float, bool or str."""
    return data_type in ScalarTypesTuple


def extract_type(data_type: AllowedTypesType) -> Tuple[ScalarTypesType, bool]:
    """
    Return the scalar type, and whether a list of it is meant.

    :raises ValueError: for a type that isn't allowed.
    """
    scalar: Any = data_type
    arguments = getattr(data_type, '__args__', None) if is_typing_list(data_type) else None
    if arguments:
        scalar = arguments[0]
    if not is_valid_scalar_type(scalar):
        raise ValueError(f'Unrecognized data type: {data_type}')
    return scalar, bool(arguments)


def is_instance_of_valid_type(value: Any, *, can_be_str: bool = False) -> bool:
    """Say whether it is a scalar or a uniform list (with texts in it if ``can_be_str``)."""
    if not isinstance(value, list):
        return isinstance(value, ScalarTypesTuple)
    kind = next((type(item) for item in value if type(item) is not str), str)
    kinds = (kind, str) if can_be_str else (kind,)
    return kind in ScalarTypesTuple and all(isinstance(item, kinds) for item in value)


def is_instance_of(
    value: Any, data_type: Optional[AllowedTypesType] = None, *, can_be_str: bool = False
) -> bool:
    """Say whether the value is of the type; without one, of any that is allowed."""
    if data_type is None:
        return is_instance_of_valid_type(value, can_be_str=can_be_str)
    kind, is_list = extract_type(data_type)
    kinds = (str, kind) if can_be_str else (kind,)
    if is_list:
        return isinstance(value, list) and all(isinstance(item, kinds) for item in value)
    return isinstance(value, kinds)


def _from_yaml(value: str, error: str, can_be_str: bool) -> Any:
    import yaml
    if not value:
        return value
    try:
        output = yaml.safe_load(value)
    except yaml.YAMLError as exc:
        if can_be_str:
            return value
        raise ValueError(f'{error}: yaml.safe_load() failed\n{exc}') from exc
    if not is_instance_of_valid_type(output, can_be_str=can_be_str):
        raise ValueError(f'{error}: output type is not allowed, got {type(output)}')
    return output


def coerce_to_type(
    value: str, data_type: Optional[AllowedTypesType] = None, *, can_be_str: bool = False
) -> Any:
    """
    Read a text as the type; without one, as YAML.

    :param can_be_str: whether the text itself will do where it isn't of the type.
    :raises ValueError: if it can't be read so.
    """
    ensure_argument_type(value, str, 'value', 'coerce_to_type')
    if data_type is None:
        return _from_yaml(value, f"Failed to convert '{value}' using yaml rules", can_be_str)
    kind, is_list = extract_type(data_type)
    kinds: Any = (str, kind) if can_be_str else kind
    if is_list:
        error = f"Cannot convert value '{value}' to a list of '{kinds}'"
        output = _from_yaml(value, error, can_be_str)
        if not isinstance(output, list):
            raise ValueError(error)
        if not all(isinstance(item, kinds) for item in output):
            raise ValueError(f'{error}, got {output}')
        return output
    if kind is str:
        return value
    if kind in (int, float):
        try:
            return kind(value)
        except ValueError:
            if can_be_str:
                return value
            raise
    output = _from_yaml(
        {'1': 'true', '0': 'false'}.get(value, value),
        f"Failed to convert '{value}' to '{kind}'", can_be_str)
    if isinstance(output, kinds):
        return output
    raise ValueError(f"Cannot convert value '{value}' to '{kind}'")


def coerce_list(
    value: List[str], data_type: Optional[ScalarTypesType] = None, *, can_be_str: bool = False
) -> Any:
    """
    Read each text as the type, see :func:`coerce_to_type`.

    :raises ValueError: also if the result isn't uniform.
    """
    ensure_argument_type(value, list, 'value', 'coerce_list')
    output = [coerce_to_type(item, data_type, can_be_str=can_be_str) for item in value]
    if not is_instance_of_valid_type(output, can_be_str=can_be_str):
        raise ValueError(f'cannot convert value to {data_type}. Got value=`{value}`')
    return output


def get_typed_value(
    value: Union[str, List[str]], data_type: Optional[AllowedTypesType], *,
    can_be_str: bool = False
) -> Any:
    """
    Read a text or a list of texts as the type.

    :raises TypeError: for a list where a scalar is wanted.
    :raises ValueError: as :func:`coerce_to_type`.
    """
    if not isinstance(value, list):
        return coerce_to_type(value, data_type, can_be_str=can_be_str)
    kind: Optional[ScalarTypesType] = None
    if data_type is not None:
        kind, is_list = extract_type(data_type)
        if not is_list:
            raise TypeError(
                f"Cannot convert input '{value}' of type '{type(value)}' to '{kind}'")
    return coerce_list(value, kind, can_be_str=can_be_str)


def is_substitution(x: Any) -> bool:
    """Say whether it is a substitution, or texts and at least one substitution."""
    return isinstance(x, Substitution) or (
        isinstance(x, collections.abc.Sized) and isinstance(x, collections.abc.Iterable)
        and all(isinstance(item, (Substitution, str)) for item in x)
        and any(isinstance(item, Substitution) for item in x))


def normalize_typed_substitution(
    value: SomeValueType, data_type: Optional[AllowedTypesType]
) -> Any:
    """
    Return a scalar as it is, substitutions as a list, a list with its items so treated.

    :raises TypeError: if it can't be, or become, of the type.
    """
    if isinstance(value, ScalarTypesTuple):
        if not is_instance_of(value, data_type):
            raise TypeError(f"value='{value}' is not an instance of {data_type}")
        return value
    if is_substitution(value):
        return normalize_to_list_of_substitutions(cast(SomeSubstitutionsType, value))
    if not isinstance(value, collections.abc.Iterable):
        raise TypeError(
            'value should be either a scalar, a substitutions, or a mixed list of scalars and '
            f'substitutions. Got `value={value}` of type `{type(value)}`. ')
    kind: Optional[ScalarTypesType] = None
    if data_type is not None:
        kind, is_list = extract_type(data_type)
    kinds: Set[type] = set()
    for item in value:
        if isinstance(item, ScalarTypesTuple):
            kinds.add(type(item))
        elif not is_substitution(item):
            raise TypeError(
                'value is a list, and one of the items is not a scalar, a Substitution or a list '
                f"of substitutions. Got value='{value}'")
    if data_type is not None and not is_list:
        raise TypeError(
            'The provided value resolves to a list, though the required type is a scalar. '
            f"Got value='{value}', data_type='{kind}'.")
    found: Any = float if kinds == {int, float} else next(iter(kinds), None)
    if len(kinds - {int, float} if found is float else kinds) > 1:
        raise TypeError(f"Input value is not an acceptable 'SomeValueType'.Got value='{value}'")
    # Whole numbers do in a list of floats.
    if found is int and kind is float:
        found = float
    if found is not None and kind is not None and found is not kind:
        raise TypeError(
            f"Got a list of '{found}', expected a list of '{kind}'. value='{value}'")
    return [
        normalize_to_list_of_substitutions(item) if is_substitution(item)
        else float(item) if found is float else item
        for item in cast(Sequence[Any], value)]


def is_normalized_substitution(x: Any) -> bool:
    """Say whether it is a non-empty list of substitutions."""
    return isinstance(x, list) and bool(x) and all(isinstance(i, Substitution) for i in x)


def perform_typed_substitution(
    context: LaunchContext, value: NormalizedValueType, data_type: Optional[AllowedTypesType]
) -> Any:
    """
    Return what a normalized value becomes in the context.

    :raises TypeError: for a value that isn't normalized, or a scalar of another type.
    :raises ValueError: for a result of another type.
    """
    if isinstance(value, ScalarTypesTuple):
        if data_type is not None and not is_instance_of(value, data_type):
            raise TypeError(
                f'value=`{value}` is a scalar and not an instance of `{data_type}`')
        return value
    if is_normalized_substitution(value):
        return coerce_to_type(
            perform_substitutions(context, cast(List[Substitution], value)), data_type)
    if not isinstance(value, list):
        raise TypeError(
            f"Input value is not an acceptable 'NormalizedValueType'.Got value='{value}'")
    kind: Optional[ScalarTypesType] = None
    if data_type is not None:
        kind, is_list = extract_type(data_type)
        if not is_list:
            raise ValueError(
                'The input value is a list, cannot convert it to a scalar. '
                f"Got value='{value}', expected type {kind}.")
    output = [
        coerce_to_type(perform_substitutions(context, cast(List[Substitution], item)), kind)
        if is_normalized_substitution(item) else item for item in value]
    if not is_instance_of(output, data_type):
        raise ValueError(
            'The output list is not uniform' if kind is None else
            'The output list does not match the expected type '
            f"Got value='{value}', expected type {kind}.")
    return output
