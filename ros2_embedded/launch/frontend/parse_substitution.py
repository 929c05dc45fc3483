# SPDX-License-Identifier: Apache-2.0
"""
Reads texts with ``$(name argument ...)`` in them.

A backslash takes the meaning from the character that follows. Arguments are separated by one
space; one in single or double quotes may contain spaces and parentheses.
"""
from __future__ import annotations

import re
from typing import Any, NoReturn

from .._base import Substitution, TextSubstitution
from .expose import instantiate_substitution

_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_-]*')
# Plain text: anything but the start of a substitution; an escaped $ starts none.
_TEXT = r'(?:\\.|[^$\\{0}]|\$(?!\()|\\$)+'
# An argument's plain text has no spaces, quotes, or parentheses that aren't escaped.
_WORD = r'(?:\\.|[^ $\\()\'"{0}]|\$(?!\()|\\$)+'


class _Reader:
    """Recursive descent over one text."""

    def __init__(self, text: str) -> None:
        self.__text = text
        self.__at = 0

    def read_all(self) -> list[Substitution]:
        parts = self.__parts(_TEXT, '')
        if self.__at < len(self.__text):
            self.__refuse()
        return parts

    def __parts(self, pattern: str, quote: str) -> list[Substitution]:
        parts: list[Substitution] = []
        while (part := self.__substitution(quote) or self.__plain(pattern, quote)) is not None:
            parts.append(part)
        return parts

    def __substitution(self, quote: str) -> Substitution | None:
        if not self.__text.startswith('$(', self.__at):
            return None
        self.__at += 2
        name = _NAME.match(self.__text, self.__at)
        if name is None:
            self.__refuse()
        self.__at = name.end()
        arguments: list[list[Substitution]] = []
        while self.__skip(' '):
            arguments.append(self.__argument(quote))
        if not self.__skip(')'):
            self.__refuse()
        return instantiate_substitution(name.group(), arguments or None)

    def __argument(self, quote: str) -> list[Substitution]:
        for mark in '\'"' if not quote else '':
            if self.__skip(mark):
                parts = self.__parts(_TEXT, mark)
                if not self.__skip(mark):
                    self.__refuse()
                return parts
        return self.__parts(_WORD, quote) or self.__refuse()

    def __plain(self, pattern: str, quote: str) -> Substitution | None:
        if quote:
            # The other quote is a character like any other in here.
            pattern = pattern.replace('\'"', '')
        found = re.compile(pattern.format(quote), re.DOTALL).match(self.__text, self.__at)
        if found is None:
            return None
        self.__at = found.end()
        return TextSubstitution(text=replace_escaped_characters(found.group()))

    def __skip(self, character: str) -> bool:
        found = self.__text.startswith(character, self.__at)
        self.__at += found
        return found

    def __refuse(self) -> NoReturn:
        rest = self.__text[self.__at:self.__at + 20]
        raise ValueError(
            f"can't read '{self.__text}' as text with substitutions, from column "
            f"{self.__at + 1} on: '{rest}'")


def replace_escaped_characters(data: str) -> str:
    return re.sub(r'\\(.)', r'\1', data)


def parse_substitution(string_value: str) -> list[Substitution]:
    """
    Return the substitutions that a text consists of.

    :raises ValueError: for a text that isn't well formed.
    :raises RuntimeError: for a substitution that doesn't exist.
    """
    if not string_value:
        return [TextSubstitution(text=string_value)]
    return _Reader(string_value).read_all()


def parse_if_substitutions(value: Any) -> Any:
    """
    Return texts in the value as substitutions, unless they are plain.

    :raises ValueError: for a list whose items aren't of one type.
    """
    kinds = set()

    def parse(item: Any) -> Any:
        if isinstance(item, str):
            parts = parse_substitution(item)
            if len(parts) != 1 or not isinstance(parts[0], TextSubstitution):
                return parts
            item = parts[0].text
        kinds.add(type(item))
        return item

    parsed = [parse(item) for item in value] if isinstance(value, list) else parse(value)
    if len(kinds) > 1:
        raise ValueError('The result is a non-uniform list')
    return parsed
