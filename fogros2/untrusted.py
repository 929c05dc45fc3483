# SPDX-License-Identifier: Apache-2.0
"""
Check text that a machine, a host, another robot or a tag supplied, where it enters this computer.

A hijacked machine may send anything. So such text becomes a value only here: names by
:func:`matched`, numbers by :func:`number`, JSON by :func:`parsed`, its fields by :func:`checked`.
:func:`clean` and :func:`one_line` make text fit for a terminal.
"""

from __future__ import annotations

import functools
import json
import math
import re
from typing import Any, get_args, get_origin, get_type_hints, is_typeddict, Literal, Union
import unicodedata

#: Names of accounts, absolute paths, and public host keys (``ssh-ed25519 AAAA...``).
NAME = re.compile('[a-z_][a-z0-9_-]{0,31}')
PATH = re.compile('/[^\x00-\x1f\x7f]{0,1000}')
HOST_KEY = re.compile('(?:ssh|ecdsa)-[a-z0-9-]+ [A-Za-z0-9+/]+={0,2}')
#: Largest magnitude of a number: float and every interpreter of JSON represent it exactly.
LARGEST = 2 ** 53
#: Maximum characters of JSON, because lists that are empty take 40 times as much when they are
#: parsed; maximum depth of lists and objects inside one another; maximum digits of a number.
LONGEST, DEEPEST, DIGITS = 1 << 20, 32, 20


class InvalidMessage(ValueError):
    """A value does not have its form; the text names the field, or what is wrong."""


def matched(form: re.Pattern[str], value: object) -> str:
    """
    Return a text if all of it has a form.

    :raises InvalidMessage: it is no text, or has another form.
    """
    if isinstance(value, str) and form.fullmatch(value):
        return value
    raise InvalidMessage(f'{str(value)[:80]!r} has not the form {form.pattern}')


def number(text: str) -> int:
    """
    Return a number that was written in decimal digits.

    :raises InvalidMessage: it is none, or has too many digits.
    """
    digits = text[1:] if text.startswith('-') else text
    if digits.isascii() and digits.isdigit() and len(digits) <= DIGITS:
        return int(text)
    raise InvalidMessage(f'{text[:80]!r} is no number')


def port(value: int) -> int:
    """
    Return a number if it can be a port's; 0 stands for none.

    :raises InvalidMessage: it is out of range.
    """
    if 0 <= value < 1 << 16:
        return value
    raise InvalidMessage(f'{value} is no port')


def address(text: str) -> str:
    """
    Return an IP address in its usual form, '' for none.

    :raises InvalidMessage: it is something else, or has a zone, which may be any text.
    """
    import ipaddress  # the import takes longer than all other checks
    try:
        if '%' in text:
            raise ValueError
        return str(ipaddress.ip_address(text)) if text else ''
    except ValueError:
        raise InvalidMessage(f'{text[:80]!r} is no IP address') from None


# -- JSON -------------------------------------------------------------------------------------

# without a limit, Python 3.10 takes minutes for a number of a million digits
_DECODER = json.JSONDecoder(parse_int=lambda digits: (
    int(digits) if len(digits) <= DIGITS else math.inf))


def parsed(text: str | bytes, kind: Any = None) -> Any:
    """
    Return the value of a JSON text, with all of its texts cleaned.

    :param kind: the type that it must have, see :func:`checked`; None for any.
    :raises InvalidMessage: it is no JSON, too long or too deep, has a number that is not finite,
        or another type.
    """
    if len(text) > LONGEST:
        raise InvalidMessage(f'{len(text)} characters of JSON')
    try:
        value = _DECODER.decode(
            text.decode(errors='replace') if isinstance(text, bytes) else text)
    except (ValueError, RecursionError) as error:
        raise InvalidMessage(f'no JSON: {str(error)[:80]}') from error
    value = _cleaned(value, DEEPEST)
    if kind is not None:
        checked(value, kind)
    return value


def _cleaned(value: Any, depth: int, field: str = '') -> Any:
    if isinstance(value, str):
        return clean(value)
    if isinstance(value, float) and not math.isfinite(value):
        raise InvalidMessage(f"field '{field}': a number out of range")
    if isinstance(value, (list, dict)):
        if not depth:
            raise InvalidMessage(f"field '{field}': lists or objects too deep in one another")
        if isinstance(value, list):
            value[:] = [_cleaned(item, depth - 1, field) for item in value]
        else:
            return {clean(name): _cleaned(item, depth - 1, clean(name))
                    for name, item in value.items()}
    return value


_hints = functools.lru_cache(maxsize=None)(get_type_hints)


def checked(value: Any, kind: Any, field: str = '') -> None:
    """
    Check that a value of JSON has a type: a TypedDict, a list, an optional one, or a plain one.

    Keys that a TypedDict does not define are ignored.

    :param field: the name of the value, for the error.
    :raises InvalidMessage: it has another type, or a number is not finite or too large.
    """
    options = get_args(kind)
    if kind is Any:
        return
    if is_typeddict(kind) and isinstance(value, dict):
        for name, expected in _hints(kind).items():
            where = f'{field}.{name}' if field else name
            if name in value:
                checked(value[name], expected, where)
            elif name in kind.__required_keys__:
                raise InvalidMessage(f"field '{where}' is missing")
        return
    if get_origin(kind) is Union:
        if value is None:
            return
        return checked(value, options[0], field)
    if get_origin(kind) is dict and isinstance(value, dict):
        for item in value.values():
            checked(item, options[1], field)
        return
    if get_origin(kind) is list and isinstance(value, list):
        for item in value:
            checked(item, options[0], field)
        return
    if get_origin(kind) is Literal and value in options:
        return
    if kind in (int, float) and type(value) in (int, kind) and abs(value) <= LARGEST:
        return  # NaN and infinity are not less than anything
    if kind in (str, bool) and isinstance(value, kind):
        return
    raise InvalidMessage(
        f"field '{field}': expected {getattr(kind, '__name__', 'object')}, got {_kind(value)}")


def _kind(value: Any) -> str:
    """Name the type of a value, or the value of a number, which may be out of range."""
    if type(value) is int and abs(value) > LARGEST or type(value) is float and not math.isfinite(
            value):
        return 'a number out of range'
    return type(value).__name__


# -- text for a terminal ----------------------------------------------------------------------

_REPLACEMENT = '\N{REPLACEMENT CHARACTER}'
_NO_COLOUR = re.compile('\x1b(?!\\[[0-9;:]*m)')
#: Unlike the other characters without a glyph, they reorder no text; many languages need them.
_JOINERS = '\N{ZERO WIDTH NON-JOINER}\N{ZERO WIDTH JOINER}'


def _harmless(character: str) -> bool:
    """Return whether a terminal may get a character; str.isprintable refuses wide spaces."""
    return character.isprintable() or character in _JOINERS \
        or unicodedata.category(character) == 'Zs'


class _Visible(dict[int, str]):
    """Characters as a terminal may get them; escape characters are those of colours."""

    def __missing__(self, code: int) -> str:
        return chr(code) if _harmless(chr(code)) else _REPLACEMENT


_VISIBLE = _Visible({0x1b: '\x1b', ord('\t'): '\t', ord('\n'): '\n', ord('\r'): '\n'})


def clean(text: str) -> str:
    """
    Replace control characters in a text, so that a terminal can show it.

    Colours, tabs and line breaks stay. A carriage return becomes a line break: it would let the
    text overwrite the name of the machine in front of it.
    """
    if text.isprintable():
        return text
    return _NO_COLOUR.sub(_REPLACEMENT, text.replace('\r\n', '\n')).translate(_VISIBLE)


def one_line(text: str) -> str:
    """Return a text in one line and without colours, as for a cell of a table."""
    return ''.join(character if _harmless(character) else ' ' if character in '\t\n\r'
                   else _REPLACEMENT for character in text)
