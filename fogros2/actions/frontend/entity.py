# SPDX-License-Identifier: Apache-2.0
"""Read an element of a launch file, in XML or YAML, as the keywords of a constructor."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Mapping
import re
from typing import Any, List, Optional, Union

from launch import Substitution
from launch.frontend import Entity, Parser
from launch.substitutions import TextSubstitution

from fogros2.describe import keywords, kinds, values
from fogros2.errors import ConfigurationError

#: A text, or substitutions to resolve later.
ParsedText = Union[str, list[Substitution]]
#: The class of an action, and its constructor's keywords.
Parsed = tuple[type[Any], dict[str, Any]]
#: The parsers' error about attributes that were not read: ``... found in `node`: {'a', 'b'}``.
_UNREAD = re.compile(r'found in `.*?`: (\{.*\})', re.DOTALL)
#: Attributes of every action.
CONDITIONS = ('if', 'unless')
_EXPECTED = {
    'text': "a text, such as '512'", 'number': 'a number', 'bool': 'true or false',
    'scalar': 'true, a number or a text', 'list': 'a list of texts'}


def text(parser: Parser, raw: str) -> ParsedText:
    """Parse a text as launch does: a plain string, or substitutions to resolve later."""
    parts: list[Substitution] = parser.parse_substitution(raw)
    plain = [part.text for part in parts if isinstance(part, TextSubstitution)]
    return ''.join(plain) if len(plain) == len(parts) else parts


def attribute(entity: Entity, parser: Parser, name: str) -> Optional[ParsedText]:
    """
    Return a text attribute, None if it is missing.

    :raises ConfigurationError: the attribute is not a text.
    """
    content: Optional[ParsedText] = value(entity, parser, kinds.Keyword(name, 'text'))
    return content


def value(
    entity: Entity, parser: Parser, keyword: kinds.Keyword, prepare: Callable[[str], str] = str,
) -> Any:
    """
    Return the value of a keyword, converted to its kind; None if it is missing.

    Texts with substitutions are resolved when the action is executed.

    :param prepare: applied to a text before launch parses it.
    :raises ConfigurationError: the value is of another kind.
    """
    if keyword.kind == 'mapping':
        return _mapping(entity, parser, keyword)
    if keyword.kind == 'table':
        return _table(entity, parser, keyword)
    if keyword.kind == 'text or mapping' and not _is_text(entity, keyword.name):
        return _mapping(entity, parser, keyword)
    raw = _raw(entity, keyword.name)
    if isinstance(raw, list):
        if keyword.kind != 'list' or not all(isinstance(item, str) for item in raw):
            raise _wrong(entity, keyword, raw)
        return [text(parser, item) for item in raw]
    if isinstance(raw, str):
        parsed = text(parser, prepare(raw))
        if isinstance(parsed, str):
            return keywords.read(keyword, parsed)
        return values.List(parsed) if keyword.kind == 'list' else parsed
    if raw is None or _fits(keyword.kind, raw):
        return raw
    raise _wrong(entity, keyword, raw)


def _is_text(entity: Entity, name: str) -> bool:
    """Return whether an attribute is a text; False if it is missing or consists of elements."""
    try:
        return entity.get_attr(name, data_type=str, optional=True) is not None
    except TypeError:
        return False


def _raw(entity: Entity, name: str) -> Union[str, int, float, bool, list[Any], None]:
    """Return an attribute as it is written: a text in XML, any scalar or list in YAML."""
    # YAML has types and refuses others; XML returns a list if x-sep is given with x. The parsers
    # compare the type object itself, so it has to be typing's List
    for kind in (str, List[str], None):
        try:
            content: Union[str, int, float, bool, list[Any], None] = entity.get_attr(
                name, data_type=kind, optional=True)
            return content
        except TypeError:
            continue
    raise ConfigurationError(
        f"{entity.type_name}: '{name}' is no value", 'write a text, a number, true or false, or '
        'several of these; names and values are elements of their own')


def _fits(kind: kinds.Kind, raw: object) -> bool:
    if isinstance(raw, bool):
        return kind in ('bool', 'scalar')
    return kind in ('number', 'scalar') and isinstance(raw, (int, float))


def _wrong(entity: Entity, keyword: kinds.Keyword, raw: object) -> ConfigurationError:
    return ConfigurationError(f"{entity.type_name}: {keyword.name} can't be {raw!r}",
                              f'it takes {_EXPECTED[keyword.kind]}')


def children(entity: Entity, name: str, attributes: Iterable[str] = ()) -> list[Entity]:
    """
    Return the child elements with this name.

    :param attributes: of each element, for the error.
    :raises ConfigurationError: there is another value, such as an attribute.
    """
    cause = None
    try:
        elements: Optional[list[Entity]] = entity.get_attr(
            name, data_type=List[Entity], optional=True)
    except TypeError as error:
        elements, cause = None, error
    if cause is not None or elements is None and _is_text(entity, name):
        xml = ' '.join(f'{each}="..."' for each in attributes) or '...'
        yaml = ', '.join(f'{each}: ...' for each in attributes) or '...'
        raise ConfigurationError(
            f"{entity.type_name}: '{name}' is no list of elements",
            f'write <{name} {xml}/> in XML, - {{{yaml}}} in YAML, for each') from cause
    return elements or []


def _mapping(entity: Entity, parser: Parser, keyword: kinds.Keyword) -> Any:
    entries: dict[str, ParsedText] = {}
    for child in children(entity, keyword.name, ('name', 'value')):
        name, content = attribute(child, parser, 'name'), attribute(child, parser, 'value')
        complete(child, ('name', 'value'))
        if not isinstance(name, str) or content is None:
            raise ConfigurationError(f'{entity.type_name}: {keyword.name} takes a name, written '
                                     'out, and a value', '<{0} name="..." value="..."/>'.format(
                                         keyword.name))
        entries[name] = content
    return entries or None


def _table(entity: Entity, parser: Parser, keyword: kinds.Keyword) -> Any:
    rows: list[Mapping[str, Any]] = []
    for child in children(entity, keyword.name, keyword.columns):
        columns = {name: value(child, parser, kinds.Keyword(name, kind))
                   for name, kind in keyword.columns.items()}
        complete(child, keyword.columns)
        rows.append({name: content for name, content in columns.items() if content is not None})
    return rows or None


def complete(entity: Entity, known: Iterable[str], what: str = '') -> None:
    """
    Refuse attributes and elements that were not read; the parsers' own error names no alternative.

    :param known: the valid attributes and elements.
    :param what: description of the element; its name by default.
    :raises ConfigurationError: something was not read; the hint has the nearest valid name.
    """
    try:
        entity.assert_entity_completely_parsed()
    except ValueError as error:
        match = _UNREAD.search(str(error))
        names = sorted(map(str, ast.literal_eval(match[1]))) if match is not None else []
        if 'True' in names:
            raise ConfigurationError(f"{what or entity.type_name} has no 'true'",
                                     "YAML reads on as true: write 'on' in quotes") from error
        if not names:
            raise ConfigurationError(str(error), 'take it out') from error
        # an older launch_ros does not read all that is known
        raise kinds.unknown(
            what or entity.type_name, names[0], {*known} - {names[0]}) from error
