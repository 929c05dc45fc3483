# SPDX-License-Identifier: Apache-2.0
"""Read the options of a machine; name an option that is unknown or has a wrong value."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import dataclasses
from typing import Any, TYPE_CHECKING, TypeVar

from fogros2.errors import ConfigurationError, did_you_mean

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Options = TypeVar('Options', bound=DataclassInstance)


def parsed(
    kind: type[Options], given: Mapping[str, Any], what: str,
    value: Callable[[str, Any, Any], Any] | None = None,
) -> Options:
    """
    Convert the options of a spec to a dataclass; other fields have their defaults.

    :param kind: a dataclass, each field with a default.
    :param what: owner of the options for messages, such as 'a container machine'.
    :param value: converts a value, given the option's name, the value and the default; None for
        ``convert``.
    :raises ConfigurationError: an option is unknown (with the nearest name) or of another type.
    """
    defaults = {field.name: {} if field.default is dataclasses.MISSING else field.default
                for field in dataclasses.fields(kind)}
    for name in given:
        if name not in defaults:
            raise ConfigurationError(
                f"{what} has no option '{name}'", did_you_mean(name, list(defaults)))
    value = value or convert
    return kind(**{name: value(name, word, defaults[name])
                   for name, word in given.items() if word is not None})


def convert(name: str, value: Any, default: Any) -> Any:
    """
    Convert an option's value to the type of its default.

    :raises ConfigurationError: the value does not fit.
    """
    if isinstance(default, tuple):
        if not isinstance(value, str) and isinstance(value, Sequence) \
                and all(isinstance(item, str) for item in value):
            return tuple(value)
        expected = 'a list of strings'
    elif isinstance(default, bool):
        if isinstance(value, bool):
            return value
        # launch arguments are strings
        if isinstance(value, str) and value.lower() in ('true', 'false'):
            return value.lower() == 'true'
        expected = 'True or False'
    elif isinstance(default, int):
        if isinstance(value, str) and value.isdecimal():
            value = int(value)
        if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
            return value
        expected = 'a whole number'
    elif isinstance(default, float):
        if isinstance(value, (int, float)) and not isinstance(value, bool) \
                and 0 < value < 1e12:
            return float(value)
        expected = 'a number above 0'
    elif isinstance(default, str):
        if isinstance(value, (str, int)) and not isinstance(value, bool):
            return str(value)
        expected = 'a string'
    else:
        if isinstance(value, Mapping) and all(
                isinstance(word, str) for pair in value.items() for word in pair):
            return dict(value)
        expected = 'names and strings'
    raise ConfigurationError(f"option '{name}' can't be {value!r}", f'it takes {expected}')
