# SPDX-License-Identifier: Apache-2.0
"""Reading the options of a machine: what is unknown or of the wrong kind is named."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
from typing import Any, TYPE_CHECKING, TypeVar

from fogros2.errors import ConfigurationError, did_you_mean

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    Options = TypeVar('Options', bound=DataclassInstance)


def known(given: Mapping[str, Any], names: Iterable[str], what: str) -> dict[str, Any]:
    """
    Return the options that aren't None.

    :param names: the names that exist.
    :param what: whose options they are, such as 'a container machine'.
    :raises ConfigurationError: one has another name; the hint has the nearest.
    """
    names = list(names)
    for name in given:
        if name not in names:
            raise ConfigurationError(
                f"{what} has no option '{name}'", did_you_mean(name, names))
    return {name: value for name, value in given.items() if value is not None}


def parsed(
    kind: type[Options], given: Mapping[str, Any], what: str,
    value: Callable[[str, Any, Any], Any] | None = None,
) -> Options:
    """
    Return the options of a spec: what isn't given has its default.

    :param kind: a dataclass, each field with a default.
    :param what: whose options they are, such as 'a container machine'.
    :param value: returns an option's value by its name, what was given, and its default;
        ``convert`` unless there are some that it can't do.
    :raises ConfigurationError: one is unknown (with the nearest name) or of another kind.
    """
    defaults = {field.name: {} if field.default is dataclasses.MISSING else field.default
                for field in dataclasses.fields(kind)}
    value = value or convert
    return kind(**{name: value(name, word, defaults[name])
                   for name, word in known(given, defaults, what).items()})


def convert(name: str, value: Any, default: Any) -> Any:
    """
    Return an option's value in the kind of its default.

    :raises ConfigurationError: it is of another kind.
    """
    if isinstance(default, tuple):
        if not isinstance(value, str) and isinstance(value, Sequence) \
                and all(isinstance(item, str) for item in value):
            return tuple(value)
        expected = 'a list of strings'
    elif isinstance(default, bool):
        if isinstance(value, bool):
            return value
        # what a launch argument comes as
        if isinstance(value, str) and value.lower() in ('true', 'false'):
            return value.lower() == 'true'
        expected = 'True or False'
    elif isinstance(default, int):
        if isinstance(value, str) and value.isdigit():
            value = int(value)
        if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
            return value
        expected = 'a whole number'
    elif isinstance(default, float):
        if isinstance(value, (int, float)) and not isinstance(value, bool) and value > 0:
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
