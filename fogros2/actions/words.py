# SPDX-License-Identifier: Apache-2.0
"""Values of launch files: plain, or substitutions that are resolved when executed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from decimal import Decimal
import os
from typing import Any, Optional, Protocol, TYPE_CHECKING

from fogros2.errors import ConfigurationError

if TYPE_CHECKING:
    from launch import LaunchContext, SomeSubstitutionsType

_TRUTHS = {'true': True, '1': True, 'false': False, '0': False}


class Items(tuple[Any, ...]):
    """Several values, each resolved alone; launch would read a plain list as one text."""


def items(values: Optional[Iterable[SomeSubstitutionsType]]) -> Optional[Items]:
    """Return values that stay apart, None for none."""
    return None if values is None else Items(values)


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
    if isinstance(value, (Number, Truth)):
        return plain(value.value)
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
        text = resolve(context, value.value)
        try:
            return float(text)
        except ValueError:
            raise ConfigurationError(f'{text!r} is no number') from None
    if isinstance(value, Truth):
        text = resolve(context, value.value)
        if not isinstance(text, str):
            return bool(text)
        if text.lower() not in _TRUTHS:
            raise ConfigurationError(f'{text!r} is neither true nor false')
        return _TRUTHS[text.lower()]
    if isinstance(value, Items):
        return [resolve(context, item) for item in value]
    if isinstance(value, Mapping):
        return {key: resolve(context, item) for key, item in value.items()}
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
    return perform_substitutions(context, normalize_to_list_of_substitutions(value))


def describe(value: Any) -> str:
    """Return a text for people: the value itself, or what a substitution says of itself."""
    if value is None or isinstance(value, (str, os.PathLike)):
        return os.fspath(value or '')
    parts = value if isinstance(value, (list, tuple)) else [value]
    return ''.join(
        part if isinstance(part, str) else f'<{part.describe()}>' for part in parts)
