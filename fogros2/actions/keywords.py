# SPDX-License-Identifier: Apache-2.0
"""
What the machines' constructors take, for those who write texts: XML, YAML, the command line.

The constructors' annotations say of what kind a value is, so a provider's keyword is an attribute
without a line of its own here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
import contextlib
import dataclasses
from decimal import Decimal
import inspect
import re
from typing import Any, get_args, get_origin, get_type_hints, Literal, Union

from fogros2 import plugin_system
from fogros2.actions import words
from fogros2.actions.machines import CloudInstance
from fogros2.errors import ConfigurationError, did_you_mean

#: Entry points that name the machines' classes, by provider.
GROUP = 'fogros2.machine'
#: Stands for no machine at all: the nodes run on this computer.
ROBOT = 'robot'

Kind = Literal[
    'text', 'number', 'truth', 'scalar', 'list', 'mapping', 'text or mapping', 'table']

#: What the annotations name that exists for type checkers alone.
_NAMES: dict[str, Any] = {
    'SomeSubstitutionsType': str, 'Value': Union[str, int, float], 'Truth': Union[bool, str],
    'ByRegion': Union[str, Mapping[str, str]],
}
#: Parameters that are not for launch files.
_NOT_MEANT = ('self', 'return', 'options', 'unknown', 'common')


@dataclasses.dataclass(frozen=True)
class Keyword:
    """
    One keyword of a constructor.

    :param columns: of a table: what each row has, by name.
    :param needed: whether the constructor can't do without.
    """

    name: str
    kind: Kind
    columns: Mapping[str, Kind] = dataclasses.field(default_factory=dict)
    needed: bool = False


class Robot(CloudInstance):
    """No machine: what is meant for it runs on the robot, and nothing is made."""

    provider = ROBOT


def providers() -> list[str]:
    """Return the names of all providers, and the one that stands for none."""
    return sorted([*plugin_system.names(GROUP), ROBOT])


def machine_class(provider: str) -> type[CloudInstance]:
    """
    Return the class of a provider's machines.

    :raises ConfigurationError: there is none; the hint has the nearest, and all.
    """
    if provider == ROBOT:
        return Robot
    if provider not in plugin_system.names(GROUP):
        raise ConfigurationError(f"no provider is called '{provider}'",
                                 did_you_mean(provider, providers(), all_too=True))
    found: type[CloudInstance] = plugin_system.load(GROUP, provider)
    return found


def keywords(cls: type[CloudInstance]) -> Mapping[str, Keyword]:
    """Return what a class of machines takes, by name; its own keywords come first."""
    found: dict[str, Keyword] = {}
    for base in cls.__mro__:
        if '__init__' not in vars(base) or not issubclass(base, CloudInstance):
            continue
        constructor = vars(base)['__init__']
        for name, keyword in parameters_of(constructor).items():
            found.setdefault(name, keyword)
    return found


def parameters_of(function: Callable[..., Any]) -> dict[str, Keyword]:
    """
    Return what a function or a constructor takes, by name.

    :raises ConfigurationError: an annotation names what isn't there to tell.
    """
    try:
        hints = get_type_hints(function, localns=_NAMES)
    except NameError as error:
        raise ConfigurationError(
            f"{function.__qualname__} can't be called from a text: {error}",
            'import what its annotations name, not for type checkers alone') from error
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
            continue  # one text, or its parts
        if isinstance(item, type) and issubclass(item, dict):
            return 'table', {name: _kind(one)[0] for name, one in get_type_hints(item).items()}
        return 'list', {}
    if bool in scalars:
        return ('scalar' if scalars & {int, float} else 'truth'), {}
    return ('number' if scalars & {int, float, Decimal} else 'text'), {}


def _options(hint: Any) -> Iterable[Any]:
    if get_origin(hint) is Union:
        for option in get_args(hint):
            if option is not type(None):
                yield from _options(option)
    else:
        yield hint


def read(keyword: Keyword, text: str) -> Any:
    """
    Return a plain text as the value that the constructor takes.

    :raises ConfigurationError: it is of another kind.
    """
    try:
        return _read(keyword, text)
    except ConfigurationError as error:
        raise ConfigurationError(f'{keyword.name}: {error.args[0]}', error.hint) from error


def _read(keyword: Keyword, text: str) -> Any:
    if keyword.kind == 'truth':
        return words.read_truth(text)
    if keyword.kind == 'list':
        return words.split(text)
    if keyword.kind == 'scalar' and text.lower() in ('true', 'false'):
        return words.read_truth(text)
    if keyword.kind in ('number', 'scalar'):
        return number(text)
    if keyword.kind in ('mapping', 'table') or (
            keyword.kind == 'text or mapping' and text.startswith('{')):
        return _nested(keyword, text)
    return text


def number(text: str) -> Union[int, float, str]:
    """Return the number in a text, the text itself where there is none, such as '8h'."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _nested(keyword: Keyword, text: str) -> Any:
    """Return a mapping, or a table's rows, of YAML's: ``{a: b}``, ``[{key: gpu}]``."""
    found = words.read_yaml(text)
    if keyword.kind != 'table':
        if isinstance(found, dict) and all(isinstance(one, str) for one in found.values()):
            return found
        raise ConfigurationError(f'{text!r} has no names and texts', 'write {name: value}')
    if not isinstance(found, list) or not all(isinstance(row, dict) for row in found):
        raise ConfigurationError(f'{text!r} is no list of mappings', 'write [{name: value}]')
    return [row_of(keyword, row) for row in found]


def row_of(keyword: Keyword, row: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return a table's row with its values in their kinds.

    :raises ConfigurationError: it has a column that the table hasn't.
    """
    for name in row:
        if name not in keyword.columns:
            raise unknown(keyword.name, name, keyword.columns)
    return {name: read(Keyword(name, keyword.columns[name]), value)
            if isinstance(value, str) else value for name, value in row.items()}


def make(provider: str, given: Mapping[str, Any]) -> CloudInstance:
    """
    Return a machine's description.

    :param given: its constructor's keywords.
    :raises ConfigurationError: no such provider or keyword, a wrong value, or one lacks.
    """
    cls = machine_class(provider)
    known = keywords(cls)
    for name in given:
        if name not in known:
            raise unknown(f"a machine of the provider '{provider}'", name, known)
    for keyword in known.values():
        if keyword.needed and keyword.name not in given:
            raise ConfigurationError(
                f"a machine of the provider '{provider}' needs {keyword.name}",
                f'{keyword.name}= says it')
    return cls(**given)


@contextlib.contextmanager
def refused(cls: type[Any]) -> Iterator[None]:
    """
    Name the nearest keyword where a constructor that the block calls knows none of that name.

    :param cls: the class; launch's actions hand on keywords from class to class.
    """
    try:
        yield
    except TypeError as error:
        match = re.search(r"got an unexpected keyword argument '(\w+)'", str(error))
        if match is None:
            raise
        known = {name for each in cls.__mro__ if '__init__' in vars(each)
                 for name in inspect.signature(vars(each)['__init__']).parameters}
        raise unknown(f'a {cls.__name__}', match[1], known - {'self', 'args', 'kwargs'}) from None


def unknown(what: str, name: str, known: Iterable[str]) -> ConfigurationError:
    """Return the error for a name that there isn't, with the nearest that there is."""
    return ConfigurationError(f"{what} has no '{name}'", did_you_mean(name, sorted(known)))
