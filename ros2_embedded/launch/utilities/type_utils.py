# SPDX-License-Identifier: Apache-2.0
"""Values that are scalars, uniform lists, or substitutions that become either."""
from __future__ import annotations

import collections.abc
import os
from typing import Any, List

from .._base import normalize_to_list_of_substitutions, perform_substitutions, Substitution
from ..launch_context import LaunchContext
from . import ensure_argument_type
from .ros_yaml import load

ScalarTypesTuple = (int, float, bool, str)


def is_typing_list(data_type: Any) -> bool:
    return data_type is List or getattr(data_type, '__origin__', None) is list


def is_valid_scalar_type(data_type: Any) -> bool:
    return data_type in ScalarTypesTuple


def extract_type(data_type: Any) -> tuple[Any, bool]:
    """
    Return the scalar type, and whether a list of it is meant; for None, any and a list.

    :raises ValueError: for a type that isn't allowed.
    """
    if data_type is None:
        return None, True
    arguments = getattr(data_type, '__args__', None) if is_typing_list(data_type) else None
    scalar = arguments[0] if arguments else data_type
    if not is_valid_scalar_type(scalar):
        raise ValueError(f'Unrecognized data type: {data_type}')
    return scalar, bool(arguments)


def is_instance_of(value: Any, data_type: Any = None, *, can_be_str: bool = False) -> bool:
    """
    Say whether the value is of the type; without one, whether it is a scalar or a uniform list.

    :param can_be_str: whether texts will do, too.
    """
    items = value if isinstance(value, list) else [value]
    kind, is_list = extract_type(data_type)
    if kind is None:
        kinds = {type(item) for item in items} - ({str} if can_be_str else set())
        return len(kinds) <= 1 and kinds <= set(ScalarTypesTuple)
    if isinstance(value, str) and can_be_str and not is_list:
        return True
    return is_list == isinstance(value, list) and all(
        isinstance(item, (kind, str) if can_be_str else kind) for item in items)


def coerce_to_type(value: str, data_type: Any = None, *, can_be_str: bool = False) -> Any:
    """
    Read a text as the type; without one, as rcl reads YAML.

    :param can_be_str: whether the text itself will do where it isn't of the type.
    :raises ValueError: if it can't be read so.
    """
    ensure_argument_type(value, str, 'value', 'coerce_to_type')
    kind, is_list = extract_type(data_type)
    is_list = is_list and kind is not None
    if kind is str and not is_list or kind is None and not value:
        return value
    if kind in (int, float) and not is_list:
        try:
            return kind(value)
        except ValueError:
            if can_be_str:
                return value
            raise
    import yaml
    given = {'1': 'true', '0': 'false'}.get(value, value) if data_type is bool else value
    try:
        output = load(given)
    except yaml.YAMLError as exc:
        if can_be_str:
            return value
        raise ValueError(f"Failed to convert '{value}' using yaml rules\n{exc}") from exc
    if not is_instance_of(output, data_type, can_be_str=can_be_str):
        wanted = f"'{kind}'" if kind else 'an allowed type'
        raise ValueError(f"Cannot convert value '{value}' to {'a list of ' * is_list}{wanted}: "
                         f'got {type(output)}')
    return output


def coerce_list(value: list[str], data_type: Any = None, *, can_be_str: bool = False) -> Any:
    """Read each text of a list as the type, as :func:`coerce_to_type` does."""
    ensure_argument_type(value, list, 'value', 'coerce_list')
    output = [coerce_to_type(item, data_type, can_be_str=can_be_str) for item in value]
    if not is_instance_of(output, can_be_str=can_be_str):
        raise ValueError(f'cannot convert value to {data_type}. Got value=`{value}`')
    return output


def get_typed_value(value: Any, data_type: Any, *, can_be_str: bool = False) -> Any:
    """
    Read a text or a list of texts as the type.

    :raises TypeError: for a list where a scalar is wanted.
    :raises ValueError: as :func:`coerce_to_type`, and for a list that isn't uniform.
    """
    if not isinstance(value, list):
        return coerce_to_type(value, data_type, can_be_str=can_be_str)
    kind, is_list = extract_type(data_type)
    if not is_list:
        raise TypeError(f"Cannot convert input '{value}' of type '{type(value)}' to '{kind}'")
    return coerce_list(value, kind, can_be_str=can_be_str)


def is_substitution(x: Any) -> bool:
    """Say whether it is a substitution, or texts and at least one substitution."""
    return isinstance(x, Substitution) or (
        isinstance(x, collections.abc.Collection)
        and all(isinstance(item, (Substitution, str)) for item in x)
        and any(isinstance(item, Substitution) for item in x))


def normalize_typed_substitution(value: Any, data_type: Any) -> Any:
    """
    Return a scalar as it is, substitutions as a list, a list with its items so treated.

    :raises TypeError: if it can't be, or become, of the type.
    """
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    error = TypeError(f"value='{value}' of {type(value)} is not an instance of {data_type}")
    if isinstance(value, ScalarTypesTuple):
        if not is_instance_of(value, data_type):
            raise error
        return value
    if is_substitution(value):
        return normalize_to_list_of_substitutions(value)
    kind, is_list = extract_type(data_type)
    if not is_list or not isinstance(value, collections.abc.Iterable):
        raise error
    items = [normalize_to_list_of_substitutions(item) if is_substitution(item) else item
             for item in value]
    kinds = {type(item) for item in items if not isinstance(item, list)}
    # Whole numbers do in a list of floats.
    if kinds and kinds <= {int, float} and (kind is float or float in kinds):
        items = [item if isinstance(item, list) else float(item) for item in items]
        kinds = {float}
    if len(kinds) > 1 or not kinds <= {*ScalarTypesTuple} or kinds and kind not in (None, *kinds):
        raise error
    return items


def is_normalized_substitution(x: Any) -> bool:
    return isinstance(x, list) and bool(x) and all(isinstance(item, Substitution) for item in x)


def perform_typed_substitution(context: LaunchContext, value: Any, data_type: Any) -> Any:
    """
    Return what a normalized value becomes in the context.

    :raises TypeError: for a value that isn't normalized, or a scalar of another type.
    :raises ValueError: for a result of another type.
    """
    def perform(item: Any, kind: Any) -> Any:
        if is_normalized_substitution(item):
            return coerce_to_type(perform_substitutions(context, item), kind)
        return item

    output = perform(value, data_type)
    if output is not value:
        return output
    if isinstance(value, list):
        output = [perform(item, extract_type(data_type)[0]) for item in value]
        if is_instance_of(output, data_type):
            return output
        raise ValueError('The output list does not match the expected type. '
                         f"Got value='{value}', expected type {data_type}.")
    if not is_instance_of(value, data_type):
        raise TypeError(f'value=`{value}` is not an instance of `{data_type}`')
    return value
