# SPDX-License-Identifier: Apache-2.0
"""
Find the kinds of values that a constructor takes, from its annotations.

So a provider's option is declared once for launch files: as a parameter of the machine's class.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
import dataclasses
from decimal import Decimal
import functools
import inspect
import os
import types
from typing import Any, get_args, get_origin, get_type_hints, Literal, Union

from fogros2.describe import values
from fogros2.errors import ConfigurationError, did_you_mean

Kind = Literal[
    'text', 'number', 'bool', 'scalar', 'list', 'mapping', 'text or mapping', 'table']

#: Names in annotations that exist only for type checkers.
_NAMES: dict[str, Any] = {
    'SomeSubstitutionsType': str, 'Value': Union[str, int, float], 'Bool': Union[bool, str],
    'Scalar': Union[str, int, float, bool],
    'ByRegion': Union[str, Mapping[str, str]],
}
#: Parameters that launch files cannot set.
_NOT_MEANT = ('self', 'return', 'options', 'unknown', 'common')


@dataclasses.dataclass(frozen=True)
class Keyword:
    """
    One keyword of a constructor.

    :param columns: for a table, the kind of each column by name.
    :param default: as of :class:`inspect.Parameter`.
    """

    name: str
    kind: Kind
    columns: Mapping[str, Kind] = dataclasses.field(default_factory=dict)
    default: Any = None

    @property
    def needed(self) -> bool:
        """Whether the constructor requires the keyword."""
        return self.default is inspect.Parameter.empty


@functools.cache
def parameters_of(function: Callable[..., Any]) -> dict[str, Keyword]:
    """
    Return the keywords of a function or a constructor by name.

    :raises ConfigurationError: an annotation uses a name that cannot be imported.
    """
    try:
        hints = get_type_hints(function, localns=_NAMES)
    except NameError as error:
        raise ConfigurationError(
            f"{function.__qualname__} can't be called from a text: {error}",
            'import the types of its annotations, not only for type checkers') from error
    parameters = inspect.signature(function).parameters
    return {
        name: Keyword(name, *_kind(hint), parameters[name].default)
        for name, hint in hints.items() if name not in _NOT_MEANT}


def _kind(hint: Any) -> tuple[Kind, Mapping[str, Kind]]:
    scalars: set[Any] = set()
    options = list(_options(hint))
    for option in options:
        if get_origin(option) in (None, Literal):
            scalars.add(option)
            continue
        item = get_args(option)[-1]
        if issubclass(get_origin(option), Mapping):
            return ('text or mapping' if str in options else 'mapping'), {}
        if str in options:
            continue  # a text, or a list of its parts
        if isinstance(item, type) and issubclass(item, dict):
            return 'table', {name: _kind(one)[0] for name, one in get_type_hints(item).items()}
        return 'list', {}
    if bool in scalars:
        return ('scalar' if scalars & {int, float} else 'bool'), {}
    return ('number' if scalars & {int, float, Decimal} else 'text'), {}


def _options(hint: Any) -> Iterable[Any]:
    if get_origin(hint) in (Union, types.UnionType):
        for option in get_args(hint):
            if option is not type(None):
                yield from _options(option)
    else:
        yield hint


def check(keywords: Mapping[str, Keyword], arguments: Mapping[str, Any]) -> None:
    """
    Check the types of a constructor's arguments.

    :raises ConfigurationError: an argument is nothing that its keyword can take.
    """
    for name, keyword in keywords.items():
        value = arguments[name]
        if keyword.kind == 'list' and isinstance(value, str):
            raise ConfigurationError(f'{name}={value!r} is no list', f'{name}=[{value!r}]')
        if not _fits(keyword.kind, value):
            raise ConfigurationError(f'{name}={value!r} has the wrong type',
                                     f'it takes a {keyword.kind}')


def _fits(kind: Kind, value: Any) -> bool:
    if value is None or isinstance(value, values.Converted):
        return True
    if isinstance(value, bool):
        return kind in ('bool', 'scalar')
    if isinstance(value, Mapping):
        return kind in ('mapping', 'text or mapping') and all(
            isinstance(one, str) for one in value)
    # a substitution is recognised by its method: describing a machine does not import launch
    if kind == 'mapping' or hasattr(value, 'perform'):
        return kind != 'mapping'
    if kind == 'table':
        return isinstance(value, (list, tuple)) and all(isinstance(row, Mapping) for row in value)
    if kind == 'list':
        return isinstance(value, (list, tuple, set, frozenset)) and all(
            one is not None and _fits('text', one) for one in value)
    if isinstance(value, (list, tuple)):  # parts of a text
        return all(isinstance(one, (str, os.PathLike)) or hasattr(one, 'perform')
                   for one in value)
    return isinstance(value, (str, int, float, Decimal, os.PathLike))


def names_of(cls: type[Any]) -> set[str]:
    """Return the names of all parameters of a class's constructors."""
    return {name for each in cls.__mro__ if '__init__' in vars(each)
            for name in inspect.signature(vars(each)['__init__']).parameters} - {
                *_NOT_MEANT, 'args', 'kwargs', 'lists'}


def unknown(what: str, name: str, names: Iterable[str]) -> ConfigurationError:
    """Return the error for an unknown name, with the nearest known one in its hint."""
    return ConfigurationError(f"{what} has no '{name}'", did_you_mean(name, sorted(names)))


def options_of(constructor: Callable[..., Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the arguments of a machine's constructor as options, marked by their kinds.

    :param arguments: the arguments by name, and other names, which are ignored.
    :raises ConfigurationError: an argument has a wrong type.
    """
    return marked(parameters_of(constructor), arguments)


def marked(keywords: Mapping[str, Keyword], arguments: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the arguments of some keywords, marked by their kinds.

    :raises ConfigurationError: an argument has a wrong type.
    """
    check(keywords, arguments)
    return {name: _MARKS[keyword.kind](arguments[name]) if keyword.kind in _MARKS
            else arguments[name] for name, keyword in keywords.items()}


_MARKS: Mapping[Kind, Callable[[Any], Any]] = {
    'number': values.Number.of, 'bool': values.Bool.of, 'list': values.items,
    'table': values.items}
