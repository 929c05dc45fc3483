# SPDX-License-Identifier: Apache-2.0
"""Values of launch files: plain, or substitutions that are resolved at execution."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from decimal import Decimal
import os
from typing import Any, Optional, Protocol, TYPE_CHECKING, Union

from fogros2.errors import ConfigurationError

if TYPE_CHECKING:
    from launch import LaunchContext, SomeSubstitutionsType, Substitution

_TRUTHS = {'true': True, '1': True, 'false': False, '0': False}


class Items(tuple[Any, ...]):
    """Several values, each resolved separately; launch would read a plain list as one text."""


class Listed:
    """A text that contains several values once it is resolved; see :func:`split`."""

    def __init__(self, value: Any) -> None:
        self.value = value


def items(
    values: Union[Iterable[SomeSubstitutionsType], Substitution, Listed, None],
) -> Union[Items, Listed, None]:
    """Return values as separate items, None for none; a substitution contains them in one text."""
    if values is None or isinstance(values, Listed):
        return values
    # recognised by its method: describing a machine does not import launch
    return Listed(values) if hasattr(values, 'perform') else Items(values)


def split(text: str) -> list[str]:
    """
    Split a text into values: ``a, b``, or YAML's ``[a, b]``; an empty text has none.

    :raises ConfigurationError: it begins with '[' and is not a YAML list of texts.
    """
    if not text.lstrip().startswith('['):
        return [part.strip() for part in text.split(',') if part.strip()]
    found = read_yaml(text)
    if not isinstance(found, list) or not all(isinstance(item, str) for item in found):
        raise ConfigurationError(f'{text!r} is no list of texts', "write 'a, b' or '[a, b]'")
    return found


def read_yaml(text: str) -> Any:
    """Parse YAML, with scalars as texts; return None if it is invalid."""
    import yaml
    # the base of the safe loader; it does not convert 2222:22 to a number
    loader = yaml.BaseLoader(text)
    try:
        return loader.get_single_data()
    except yaml.YAMLError:
        return None
    finally:
        loader.dispose()


class Number:
    """A value that resolves to a number; a substitution resolves to text only."""

    def __init__(self, value: Any) -> None:
        self.value = value


def number(value: Any) -> Optional[Number]:
    """Mark a value as a number, None for none."""
    return None if value is None else Number(value)


class Truth:
    """A value that resolves to True or False, with the syntax of launch's conditions."""

    def __init__(self, value: Any) -> None:
        self.value = value


def truth(value: Any) -> Optional[Truth]:
    """Mark a value as True or False, None for none."""
    return None if value is None else Truth(value)


class Later(Protocol):
    """A value that takes time to obtain: the call makes the request, in a thread."""

    def __call__(self) -> str:
        """
        Return the value; a second call returns the same.

        :raises FogError: the request failed, or there is no such value.
        """


def resolve_later(context: LaunchContext, value: Any) -> Any:
    """Resolve a value like ``resolve``, but return a slow value as a :class:`Later`."""
    later = getattr(value, 'later', None)
    return resolve(context, value) if later is None else later(context)


def answered(options: Mapping[str, Any]) -> dict[str, Any]:
    """
    Call every :class:`Later` among options; run it in a thread.

    :raises FogError: a value cannot be obtained.
    """
    return {key: value() if callable(value) else value for key, value in options.items()}


def plain(value: Any) -> Any:
    """Return the value without its mark, or a description of an unresolved one."""
    if isinstance(value, (Number, Truth, Listed)):
        return plain(value.value)
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    return value if value is None or isinstance(value, (bool, int, float)) else describe(value)


def resolve(context: LaunchContext, value: Any) -> Any:
    """
    Resolve the substitutions in a value.

    A list or tuple is one text in parts, as everywhere in launch. Items become a list. Values of
    other types are returned unchanged.
    """
    if value is None or isinstance(value, (str, int, float, Decimal)):
        return value
    if isinstance(value, Number):
        return _number(resolve(context, value.value))
    if isinstance(value, Truth):
        return read_truth(resolve(context, value.value))
    if isinstance(value, Listed):
        return split(resolve(context, value.value))
    if isinstance(value, Items):
        return [resolve(context, item) for item in value]
    if isinstance(value, Mapping):
        return {key: resolve(context, item) for key, item in value.items()}
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
    return perform_substitutions(context, normalize_to_list_of_substitutions(value))


def is_text(value: Any) -> bool:
    """Return whether a value is a text, or what launch resolves to one."""
    from launch import Substitution
    parts = value if isinstance(value, (list, tuple)) and value else [value]
    return all(isinstance(part, (str, Substitution)) for part in parts)


def check_plain(value: Any) -> None:
    """
    Check a Number or a Truth whose value is known already.

    :raises ConfigurationError: the value is something else.
    """
    if isinstance(value, (Number, Truth)) and isinstance(
            value.value, (str, bool, int, float, Decimal)):
        (_number if isinstance(value, Number) else read_truth)(value.value)


def _number(value: Any) -> float:
    try:
        return float(value)
    except ValueError:
        raise ConfigurationError(f'{value!r} is no number', 'such as 2 or 1.5') from None


def read_truth(value: Any) -> bool:
    """
    Convert a text to True or False, as launch does for a condition; other values by ``bool``.

    :raises ConfigurationError: the text is neither.
    """
    if not isinstance(value, str):
        return bool(value)
    if value.lower() not in _TRUTHS:
        raise ConfigurationError(f'{value!r} is neither true nor false', 'write one of the two')
    return _TRUTHS[value.lower()]


def describe(value: Any) -> str:
    """Return a readable text: the value itself, or a substitution's description."""
    if value is None or isinstance(value, (str, os.PathLike)):
        return os.fspath(value or '')
    parts = value if isinstance(value, (list, tuple)) else [value]
    return ''.join(
        part if isinstance(part, str) else f'<{part.describe()}>' for part in parts)
