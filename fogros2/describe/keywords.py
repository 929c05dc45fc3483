# SPDX-License-Identifier: Apache-2.0
"""
Read the keywords of the machines' constructors from text: XML, YAML, the command line.

The annotations of a constructor give the kind of each value, so a keyword of a provider becomes
an attribute without any code here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import contextlib
import re
from typing import Any

from fogros2 import plugin_system
from fogros2.describe import features, values
from fogros2.describe.kinds import Keyword, names_of, parameters_of, unknown
from fogros2.describe.machines import CloudInstance
from fogros2.errors import ConfigurationError, did_you_mean, PrerequisiteError

#: Entry point group of the machines' classes, by provider.
GROUP = 'fogros2.machine'
#: The provider name for no machine: the nodes run on this computer.
ROBOT = 'robot'

class Robot(CloudInstance):
    """No machine: its nodes run on the robot, and nothing is created."""

    provider = ROBOT


def providers() -> list[str]:
    """Return the names of all providers, and 'robot'."""
    return sorted([*plugin_system.names(GROUP), ROBOT])


def machine_class(provider: str) -> type[CloudInstance]:
    """
    Return the class of a provider's machines.

    :raises ConfigurationError: no such provider; the hint names the nearest one and all.
    :raises PrerequisiteError: the class can't be loaded.
    """
    if provider == ROBOT:
        return Robot
    if provider not in plugin_system.names(GROUP):
        raise ConfigurationError(f"there is no provider '{provider}'",
                                 did_you_mean(provider, providers(), all_too=True))
    cls: type[CloudInstance] = plugin_system.load(GROUP, provider)
    return cls


def machine_classes() -> Iterator[type[CloudInstance]]:
    """Yield the classes of all providers but those that can't be loaded."""
    for provider in providers():
        with contextlib.suppress(PrerequisiteError):
            yield machine_class(provider)


def keywords(cls: type[CloudInstance]) -> Mapping[str, Keyword]:
    """Return the keywords of a machine class by name; its own come before inherited ones."""
    by_name: dict[str, Keyword] = {}
    for base in cls.__mro__:
        if '__init__' not in vars(base) or not issubclass(base, CloudInstance):
            continue
        constructor = vars(base)['__init__']
        for name, keyword in parameters_of(constructor).items():
            by_name.setdefault(name, keyword)
    of_features = features.keywords()
    for name in by_name.keys() & of_features.keys():
        raise ConfigurationError(f"a feature has the keyword '{name}' of a {cls.__name__}",
                                 'uninstall the feature')
    return {**of_features, **by_name}


def read(keyword: Keyword, text: str) -> Any:
    """
    Convert text to the value that the constructor expects.

    :raises ConfigurationError: the text does not fit the keyword's kind.
    """
    with values.named(keyword.name):
        if keyword.kind == 'bool' or keyword.kind == 'scalar' and text.lower() in (
                'true', 'false'):
            return values.read_bool(text)
        if keyword.kind == 'list':
            return values.split(text)
        if keyword.kind in ('number', 'scalar'):
            return values.number(text)
        if keyword.kind in ('mapping', 'table') or (
                keyword.kind == 'text or mapping' and text.startswith('{')):
            return _nested(keyword, text)
        return text


def _nested(keyword: Keyword, text: str) -> Any:
    """Parse a YAML mapping, or the rows of a table: ``{a: b}``, ``[{key: gpu}]``."""
    content = values.read_yaml(text)
    if keyword.kind != 'table':
        if isinstance(content, dict) and all(isinstance(one, str) for one in content.values()):
            return content
        raise ConfigurationError(f'{text!r} has no names and texts', 'write {name: value}')
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise ConfigurationError(f'{text!r} is no list of mappings', 'write [{name: value}]')
    return [row_of(keyword, row) for row in content]


def row_of(keyword: Keyword, row: Mapping[str, Any]) -> dict[str, Any]:
    """
    Convert the values of a table's row to their kinds.

    :raises ConfigurationError: the table has no such column.
    """
    for name in row:
        if name not in keyword.columns:
            raise unknown(keyword.name, name, keyword.columns)
    return {name: read(Keyword(name, keyword.columns[name]), value)
            if isinstance(value, str) else value for name, value in row.items()}


def make(provider: str, arguments: Mapping[str, Any]) -> CloudInstance:
    """
    Create a machine's description.

    :param arguments: keywords of its constructor.
    :raises ConfigurationError: an unknown provider or keyword, a wrong value, or a missing one.
    """
    cls = machine_class(provider)
    parameters = keywords(cls)
    for name in arguments:
        if name not in parameters:
            raise unknown(f"a machine of the provider '{provider}'", name, parameters)
    for keyword in parameters.values():
        if keyword.needed and keyword.name not in arguments:
            raise ConfigurationError(
                f"a machine of the provider '{provider}' needs {keyword.name}",
                f'{keyword.name}= says it')
    return cls(**arguments)


@contextlib.contextmanager
def refused(cls: type[Any], more: Iterable[str] = ()) -> Iterator[None]:
    """
    Replace the error of an unexpected keyword by one that names the nearest keyword.

    :param cls: the class; launch's actions pass keywords on to their base classes.
    :param more: keywords of features.
    """
    try:
        yield
    except TypeError as error:
        match = re.search(r"got an unexpected keyword argument '(\w+)'", str(error))
        if match is None:
            raise
        raise unknown(f'a {cls.__name__}', match[1], {
            *more, *features.node_lists(), *names_of(cls)}) from None
