# SPDX-License-Identifier: Apache-2.0
"""Values that are scalars, uniform lists, or substitutions that become either."""
from __future__ import annotations

import collections.abc
from typing import Any, List, Optional, Sequence, Tuple, Type, TYPE_CHECKING, Union

from .._base import SomeSubstitutionsType, Substitution
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
SequenceValueType = Union[Sequence[int], Sequence[float], Sequence[bool], Sequence[str]]
AllowedValueType = Union[ScalarValueType, SequenceValueType]
SomeValueType = Union[
    SomeSubstitutionsType, ScalarValueType,
    Sequence[Union[int, float, bool, str, SomeSubstitutionsType]]]
NormalizedValueType = Any
StrSomeValueType = Any


def is_typing_list(data_type: Any) -> bool:
    return data_type is List or getattr(data_type, '__origin__', None) is list


def is_valid_scalar_type(data_type: Any) -> bool:
    return data_type in ScalarTypesTuple


def extract_type(data_type: Any) -> Tuple[Any, bool]:
    """
    Return the scalar type, and whether a list of it is meant.

    :raises ValueError: for a type that isn't allowed.
    """
    arguments = getattr(data_type, '__args__', None) if is_typing_list(data_type) else None
    scalar = arguments[0] if arguments else data_type
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


def coerce_to_type(
    value: str, data_type: Optional[AllowedTypesType] = None, *, can_be_str: bool = False
) -> Any:
    """
    Read a text as the type; without one, as YAML.

    :param can_be_str: whether the text itself will do where it isn't of the type.
    :raises ValueError: if it can't be read so.
    """
    ensure_argument_type(value, str, 'value', 'coerce_to_type')
    kind, is_list = (None, False) if data_type is None else extract_type(data_type)
    if kind is str and not is_list:
        return value
    if kind in (int, float) and not is_list:
        try:
            return kind(value)
        except ValueError:
            if can_be_str:
                return value
            raise
    if kind is bool and not is_list:
        value = {'1': 'true', '0': 'false'}.get(value, value)
    error = (f"Failed to convert '{value}' using yaml rules" if kind is None else
             f"Cannot convert value '{value}' to " + (f"a list of '{kind}'" if is_list else
                                                      f"'{kind}'"))
    if kind is None and not value:
        return value
    import yaml
    try:
        output = yaml.safe_load(value)
    except yaml.YAMLError as exc:
        if can_be_str:
            return value
        raise ValueError(f'{error}: yaml.safe_load() failed\n{exc}') from exc
    if not is_instance_of(output, data_type, can_be_str=can_be_str):
        raise ValueError(f'{error}: output type is not allowed, got {type(output)}')
    return output


def coerce_list(
    value: List[str], data_type: Optional[ScalarTypesType] = None, *, can_be_str: bool = False
) -> Any:
    """Read each text as the type, see :func:`coerce_to_type`; the result must be uniform."""
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
    kind, is_list = (None, True) if data_type is None else extract_type(data_type)
    if not is_list:
        raise TypeError(f"Cannot convert input '{value}' of type '{type(value)}' to '{kind}'")
    return coerce_list(value, kind, can_be_str=can_be_str)


def is_substitution(x: Any) -> bool:
    """Say whether it is a substitution, or texts and at least one substitution."""
    return isinstance(x, Substitution) or (
        isinstance(x, collections.abc.Sized) and isinstance(x, collections.abc.Iterable)
        and all(isinstance(item, (Substitution, str)) for item in x)
        and any(isinstance(item, Substitution) for item in x))


def normalize_typed_substitution(value: Any, data_type: Optional[AllowedTypesType]) -> Any:
    """
    Return a scalar as it is, substitutions as a list, a list with its items so treated.

    :raises TypeError: if it can't be, or become, of the type.
    """
    if isinstance(value, ScalarTypesTuple):
        if not is_instance_of(value, data_type):
            raise TypeError(f"value='{value}' is not an instance of {data_type}")
        return value
    if is_substitution(value):
        return normalize_to_list_of_substitutions(value)
    if not isinstance(value, collections.abc.Iterable):
        raise TypeError(
            'value should be either a scalar, a substitutions, or a mixed list of scalars and '
            f'substitutions. Got `value={value}` of type `{type(value)}`. ')
    kind, is_list = (None, True) if data_type is None else extract_type(data_type)
    kinds = set()
    for item in value:
        if isinstance(item, ScalarTypesTuple):
            kinds.add(type(item))
        elif not is_substitution(item):
            raise TypeError(
                'value is a list, and one of the items is not a scalar, a Substitution or a list '
                f"of substitutions. Got value='{value}'")
    if not is_list:
        raise TypeError(
            'The provided value resolves to a list, though the required type is a scalar. '
            f"Got value='{value}', data_type='{kind}'.")
    # Whole numbers do in a list of floats.
    as_float = kinds == {int, float} or (kinds == {int} and kind is float)
    found = float if as_float else next(iter(kinds), None)
    if len(kinds) > 1 and not as_float:
        raise TypeError(f"Input value is not an acceptable 'SomeValueType'.Got value='{value}'")
    if None not in (found, kind) and found is not kind:
        raise TypeError(f"Got a list of '{found}', expected a list of '{kind}'. value='{value}'")
    return [
        normalize_to_list_of_substitutions(item) if is_substitution(item)
        else float(item) if as_float else item for item in value]


def is_normalized_substitution(x: Any) -> bool:
    return isinstance(x, list) and bool(x) and all(isinstance(i, Substitution) for i in x)


def perform_typed_substitution(
    context: LaunchContext, value: Any, data_type: Optional[AllowedTypesType]
) -> Any:
    """
    Return what a normalized value becomes in the context.

    :raises TypeError: for a value that isn't normalized, or a scalar of another type.
    :raises ValueError: for a result of another type.
    """
    if isinstance(value, ScalarTypesTuple):
        if data_type is not None and not is_instance_of(value, data_type):
            raise TypeError(f'value=`{value}` is a scalar and not an instance of `{data_type}`')
        return value
    if is_normalized_substitution(value):
        return coerce_to_type(perform_substitutions(context, value), data_type)
    if not isinstance(value, list):
        raise TypeError(
            f"Input value is not an acceptable 'NormalizedValueType'.Got value='{value}'")
    kind, is_list = (None, True) if data_type is None else extract_type(data_type)
    output = [
        coerce_to_type(perform_substitutions(context, item), kind)
        if is_normalized_substitution(item) else item for item in value]
    if not is_list or not is_instance_of(output, data_type):
        raise ValueError(
            f"The output list does not match the expected type Got value='{value}', "
            f'expected type {kind}.')
    return output
