# SPDX-License-Identifier: Apache-2.0
"""Values of launch files: plain, or substitutions that are resolved when executed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import os
from typing import Any, Optional, TYPE_CHECKING

from fogros2.errors import ConfigurationError

if TYPE_CHECKING:
    from launch import LaunchContext, SomeSubstitutionsType


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


def resolve(context: LaunchContext, value: Any) -> Any:
    """
    Return a value with its substitutions performed.

    A list or tuple is one text in pieces, as everywhere in launch; Items become a list; other
    types are returned as they are.
    """
    if value is None or isinstance(value, (str, int, float)):
        return value
    if isinstance(value, Number):
        text = resolve(context, value.value)
        try:
            return float(text)
        except ValueError:
            raise ConfigurationError(f'{text!r} is no number') from None
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
