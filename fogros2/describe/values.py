# SPDX-License-Identifier: Apache-2.0
"""Values of launch files: plain, or substitutions that are resolved at execution."""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable, Iterator, Mapping
import contextlib
from decimal import Decimal
import os
import re
from typing import Any, cast, get_args, TYPE_CHECKING, Union

from fogros2.errors import ConfigurationError, did_you_mean

if TYPE_CHECKING:
    from launch import LaunchContext, SomeSubstitutionsType, Substitution

#: Requests a value, in a thread, because that takes time; raises FogError.
Deferred = Callable[[], str]
_SECONDS = {'s': 1.0, 'm': 60.0, 'h': 3600.0, 'd': 86400.0}
#: Seconds that a duration may have: a century.
_LONGEST = 3.2e9
_DURATION = re.compile(r'(?:\d+(?:\.\d+)?[smhd])+')
_BOOLS = {'true': True, '1': True, 'false': False, '0': False}


class Items(tuple[Any, ...]):
    """Several values, each resolved separately; launch would read a plain list as one text."""


class Converted(abc.ABC):
    """A value that is converted once it is resolved; a substitution resolves to text only."""

    def __init__(self, value: Any) -> None:
        self.value = value

    @staticmethod
    @abc.abstractmethod
    def convert(value: Any, /) -> Any:
        """
        Return a resolved value in its type.

        :raises ConfigurationError: it cannot be converted.
        """

    @classmethod
    def of(cls, value: Any) -> Any:
        """Mark a value, None for none."""
        return None if value is None else cls(value)


def items(
    values: Union[Iterable[SomeSubstitutionsType], Substitution, List, None],
) -> Union[Items, List, None]:
    """Return values as separate items, None for none; a substitution contains them in one text."""
    if values is None or isinstance(values, List):
        return values
    # recognised by its method: describing a machine does not import launch
    return List(values) if hasattr(values, 'perform') else Items(values)


@contextlib.contextmanager
def named(keyword: str) -> Iterator[None]:
    """Name the keyword in the error of a wrong value."""
    try:
        yield
    except ConfigurationError as error:
        raise ConfigurationError(f'{keyword}: {error.args[0]}', error.hint) from error


def split(text: str) -> list[str]:
    """
    Split a text into values: ``a, b``, or YAML's ``[a, b]``; an empty text has none.

    :raises ConfigurationError: it begins with '[' and is not a YAML list of texts.
    """
    if not text.lstrip().startswith('['):
        return [part.strip() for part in text.split(',') if part.strip()]
    parts = read_yaml(text)
    if not isinstance(parts, list) or not all(isinstance(item, str) for item in parts):
        raise ConfigurationError(f'{text!r} is no list of texts', "write 'a, b' or '[a, b]'")
    return parts


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


def resolve_deferred(context: LaunchContext, value: Any) -> Any:
    """Resolve a value like ``resolve``, but return a slow value as a ``Deferred``."""
    defer = getattr(value, 'defer', None)
    return resolve(context, value) if defer is None else defer(context)


def await_all(options: Mapping[str, Any]) -> dict[str, Any]:
    """
    Call every ``Deferred`` among options; run it in a thread.

    :raises FogError: a value cannot be obtained.
    """
    return {key: value() if callable(value) else value for key, value in options.items()}


def plain(value: Any) -> Any:
    """Return the value without its mark, or a description of an unresolved one."""
    if isinstance(value, Converted):
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
    if isinstance(value, Converted):
        return value.convert(resolve(context, value.value))
    if isinstance(value, Items):
        return [resolve(context, item) for item in value]
    if isinstance(value, Mapping):
        return {key: resolve(context, item) for key, item in value.items()}
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
    try:
        parts = normalize_to_list_of_substitutions(value)
    except TypeError as error:
        raise ConfigurationError(f'{value!r} is no text', 'write a text or a number') from error
    return perform_substitutions(context, parts)


def is_text(value: Any) -> bool:
    """Return whether a value is a text, or what launch resolves to one."""
    from launch import Substitution
    parts = value if isinstance(value, (list, tuple)) and value else [value]
    return all(isinstance(part, (str, Substitution)) for part in parts)


def is_known(value: Any) -> bool:
    """Return whether a marked value is known before the launch: it has no substitution."""
    if isinstance(value, Items):
        return all(isinstance(item, str) for item in value)
    if isinstance(value, Converted):
        return is_known(value.value)
    return isinstance(value, (str, int, float, Decimal))


def known(given: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return marked values, which have no substitutions, in their types.

    :raises ConfigurationError: one can't be converted.
    """
    result = {}
    for name, value in given.items():
        with named(name):
            result[name] = resolve(cast(Any, None), value)
    return result


def read_number(value: Any) -> Union[int, float]:
    """
    Convert a value to a number.

    :raises ConfigurationError: it is none.
    """
    result = number(value) if isinstance(value, str) else value
    if isinstance(result, str):
        raise ConfigurationError(f'{value!r} is no number', 'such as 2 or 1.5')
    return result if isinstance(result, (int, float)) else float(result)


def number(text: str) -> Union[int, float, str]:
    """Return the number in a text, or the text itself if it is none, such as '8h' or '1_000'."""
    for kind in (int, float) if '_' not in text else ():
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def parse_duration(what: str, value: Union[str, int, float]) -> float:
    """
    Convert a number, or text such as '90', '8h', '1h30m', '2d', to seconds.

    :raises ConfigurationError: not a duration, or not above zero.
    """
    seconds: float = 0
    if isinstance(value, str):
        text = value.replace(' ', '')
        try:
            seconds = float(text)
        except ValueError:
            if _DURATION.fullmatch(text):
                seconds = sum(
                    float(number) * _SECONDS[unit]
                    for number, unit in re.findall(r'([\d.]+)([smhd])', text))
    else:
        seconds = value
    if not 0 < seconds < _LONGEST:
        raise ConfigurationError(
            f'{what}={value!r} is no duration', "use seconds, or text such as '8h' or '1h30m'")
    return float(seconds)


def choice(kind: Any) -> Callable[[str, object], str]:
    """Return a check for a text that is one of those in a Literal."""
    def check(what: str, value: object) -> str:
        if value not in get_args(kind):
            raise ConfigurationError(
                f'{what}={value!r} is unknown',
                did_you_mean(str(value), get_args(kind),
                             f"use one of {', '.join(get_args(kind))}"))
        return str(value)
    return check


def check_folder(what: str, value: object) -> str:
    """
    Return a folder in the form ``~/map`` or ``/var/map``; ``$HOME`` stands for ``~``.

    :raises ConfigurationError: it is no folder below the home or the root.
    """
    path = re.sub(r'^\$HOME/', '~/', str(value)).rstrip('/')
    parts = path.split('/')
    if len(parts) < 2 or parts[0] not in ('~', '') or {'', '.', '..'} & {*parts[1:]}:
        raise ConfigurationError(f'{what}={value!r} is no folder that can be copied',
                                 "use a folder below the home, such as '$HOME/map'")
    return path


def read_bool(value: Any) -> bool:
    """
    Convert a text to True or False, as launch does for a condition; other values by ``bool``.

    :raises ConfigurationError: the text is neither.
    """
    if not isinstance(value, str):
        return bool(value)
    if value.lower() not in _BOOLS:
        raise ConfigurationError(f'{value!r} is neither true nor false', 'write one of the two')
    return _BOOLS[value.lower()]


class Number(Converted):
    """A value that resolves to a number."""

    convert = staticmethod(read_number)


class Bool(Converted):
    """A value that resolves to True or False, with the syntax of launch's conditions."""

    convert = staticmethod(read_bool)


class List(Converted):
    """A text that contains several values once it is resolved; see :func:`split`."""

    convert = staticmethod(split)


def describe(value: Any) -> str:
    """Return a readable text: the value itself, or a substitution's description."""
    if value is None or isinstance(value, (str, os.PathLike)):
        return os.fspath(value or '')
    parts = value if isinstance(value, (list, tuple)) else [value]
    return ''.join(
        part if isinstance(part, str) else f'<{part.describe()}>' for part in parts)
