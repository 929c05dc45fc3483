# SPDX-License-Identifier: Apache-2.0
"""
The filters of lists: ``(a = "x") (labels.b:*)``, with AND and OR, or one ``name eq REGEX``.

Source: the description of the parameter ``filter`` in the discovery document.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import re
from typing import Any

from rigs.gce.errors import Refusal

_TERM = re.compile(r'([A-Za-z][\w.-]*)\s*[=:]\s*("[^"]*"|\*|[^\s()]+)')
_REGEX = re.compile(r'([A-Za-z]\w*) eq (\S+)')
Test = Callable[[Mapping[str, Any]], bool]


def parse(text: str) -> Test:
    """
    Return the test of a filter.

    :raises Refusal: the filter is malformed.
    """
    if not text:
        return lambda entry: True
    found = _REGEX.fullmatch(text)
    if found:
        name, pattern = found.groups()
        return lambda entry: bool(re.fullmatch(pattern, str(_value(entry, name))))
    test, rest = _either(text)
    if rest:
        raise Refusal('invalid', f"Invalid value for field 'filter': '{text}'")
    return test


def _either(text: str) -> tuple[Test, str]:
    one, rest = _both(text)
    tests = [one]
    while rest.startswith('OR '):
        one, rest = _both(rest[3:].lstrip())
        tests.append(one)
    return lambda entry: any(test(entry) for test in tests), rest


def _both(text: str) -> tuple[Test, str]:
    one, rest = _term(text)
    tests = [one]
    while rest and not rest.startswith((')', 'OR ')):
        one, rest = _term(rest.removeprefix('AND ').lstrip())
        tests.append(one)
    return lambda entry: all(test(entry) for test in tests), rest


def _term(text: str) -> tuple[Test, str]:
    if text.startswith('('):
        test, rest = _either(text[1:].lstrip())
        if not rest.startswith(')'):
            raise Refusal('invalid', f"Invalid value for field 'filter': '{text}'")
        return test, rest[1:].lstrip()
    found = _TERM.match(text)
    if found is None:
        raise Refusal('invalid', f"Invalid value for field 'filter': '{text}'")
    name, value = found.groups()

    def fits(entry: Mapping[str, Any]) -> bool:
        known = _value(entry, name)
        return known is not None if value == '*' else str(known) == value.strip('"')

    return fits, text[found.end():].lstrip()


def _value(entry: Mapping[str, Any], name: str) -> Any:
    """Return a field; the key of a label may have dots of its own."""
    top, _, below = name.partition('.')
    found = entry.get(top)
    return found.get(below) if below and isinstance(found, Mapping) else found
