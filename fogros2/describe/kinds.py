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
from typing import Any, get_args, get_origin, get_type_hints, Literal, Union

from fogros2.describe import values
from fogros2.errors import ConfigurationError

Kind = Literal[
    'text', 'number', 'bool', 'scalar', 'list', 'mapping', 'text or mapping', 'table']

#: Names in annotations that exist only for type checkers.
_NAMES: dict[str, Any] = {
    'SomeSubstitutionsType': str, 'Value': Union[str, int, float], 'Bool': Union[bool, str],
    'ByRegion': Union[str, Mapping[str, str]],
}
#: Parameters that launch files cannot set.
_NOT_MEANT = ('self', 'return', 'options', 'unknown', 'common')


@dataclasses.dataclass(frozen=True)
class Keyword:
    """
    One keyword of a constructor.

    :param columns: for a table, the kind of each column by name.
    :param needed: whether the constructor requires the keyword.
    """

    name: str
    kind: Kind
    columns: Mapping[str, Kind] = dataclasses.field(default_factory=dict)
    needed: bool = False


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
        name: Keyword(name, *_kind(hint),
                      needed=parameters[name].default is inspect.Parameter.empty)
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
    if get_origin(hint) is Union:
        for option in get_args(hint):
            if option is not type(None):
                yield from _options(option)
    else:
        yield hint


def options_of(constructor: Callable[..., Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the arguments of a machine's constructor as options, marked by their kinds.

    :param arguments: the arguments by name, and other names, which are ignored.
    """
    return {name: _MARKS[keyword.kind](arguments[name]) if keyword.kind in _MARKS
            else arguments[name] for name, keyword in parameters_of(constructor).items()}


_MARKS: Mapping[Kind, Callable[[Any], Any]] = {
    'number': values.Number.of, 'bool': values.Bool.of, 'list': values.items,
    'table': values.items}
