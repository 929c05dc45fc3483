# SPDX-License-Identifier: Apache-2.0
"""Values of launch files: plain, or substitutions that are resolved when executed."""

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
    """Several values, each resolved alone; launch would read a plain list as one text."""


class Listed:
    """A text that is several values once it is resolved, as :func:`split` takes it apart."""

    def __init__(self, value: Any) -> None:
        self.value = value


def items(
    values: Union[Iterable[SomeSubstitutionsType], Substitution, Listed, None],
) -> Union[Items, Listed, None]:
    """Return values that stay apart, None for none; a substitution is several in one text."""
    if values is None or isinstance(values, Listed):
        return values
    # known by what it does: describing a machine doesn't import launch
    return Listed(values) if hasattr(values, 'perform') else Items(values)


def split(text: str) -> list[str]:
    """
    Return the values in a text: ``a, b``, or YAML's ``[a, b]``; none in an empty one.

    :raises ConfigurationError: it begins as a list of YAML's and is none, or not of texts.
    """
    if not text.lstrip().startswith('['):
        return [part.strip() for part in text.split(',') if part.strip()]
    found = read_yaml(text)
    if not isinstance(found, list) or not all(isinstance(item, str) for item in found):
        raise ConfigurationError(f'{text!r} is no list of texts', "write 'a, b' or '[a, b]'")
    return found


def read_yaml(text: str) -> Any:
    """Return what YAML there is in a text, its scalars left as texts; None for what is none."""
    import yaml
    # what the safe loader is built on; it makes no number of 2222:22
    loader = yaml.BaseLoader(text)
    try:
        return loader.get_single_data()
    except yaml.YAMLError:
        return None
    finally:
        loader.dispose()


class Number:
    """A value that is a number once it is resolved; substitutions only make texts."""

    def __init__(self, value: Any) -> None:
        self.value = value


def number(value: Any) -> Optional[Number]:
    """Return a value that resolves to a number, None for none."""
    return None if value is None else Number(value)


class Truth:
    """A value that is True or False once it is resolved, as launch reads a condition."""

    def __init__(self, value: Any) -> None:
        self.value = value


def truth(value: Any) -> Optional[Truth]:
    """Return a value that resolves to True or False, None for none."""
    return None if value is None else Truth(value)


class Later(Protocol):
    """A value that takes a while to know: calling it asks, in a thread that may wait."""

    def __call__(self) -> str:
        """
        Return the value; the second call returns the same.

        :raises FogError: nobody answers, or there is no such value.
        """


def resolve_later(context: LaunchContext, value: Any) -> Any:
    """Return as ``resolve`` does, but for a value that takes a while, which is Later."""
    later = getattr(value, 'later', None)
    return resolve(context, value) if later is None else later(context)


def answered(options: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return options with those asked for that are Later; call it in a thread.

    :raises FogError: one can't be had.
    """
    return {key: value() if callable(value) else value for key, value in options.items()}


def plain(value: Any) -> Any:
    """Return a number, a truth, or a text for people, of a value that may not be resolved yet."""
    if isinstance(value, (Number, Truth, Listed)):
        return plain(value.value)
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    return value if value is None or isinstance(value, (bool, int, float)) else describe(value)


def resolve(context: LaunchContext, value: Any) -> Any:
    """
    Return a value with its substitutions performed.

    A list or tuple is one text in pieces, as everywhere in launch; Items become a list; other
    types are returned as they are.
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
    Hold a Number or a Truth against what it has to be, as far as it is known already.

    :raises ConfigurationError: it is something else.
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
    Return the truth in a text, as launch reads a condition; or of a value that is none.

    :raises ConfigurationError: a text says neither.
    """
    if not isinstance(value, str):
        return bool(value)
    if value.lower() not in _TRUTHS:
        raise ConfigurationError(f'{value!r} is neither true nor false', 'write one of the two')
    return _TRUTHS[value.lower()]


def describe(value: Any) -> str:
    """Return a text for people: the value itself, or what a substitution says of itself."""
    if value is None or isinstance(value, (str, os.PathLike)):
        return os.fspath(value or '')
    parts = value if isinstance(value, (list, tuple)) else [value]
    return ''.join(
        part if isinstance(part, str) else f'<{part.describe()}>' for part in parts)
