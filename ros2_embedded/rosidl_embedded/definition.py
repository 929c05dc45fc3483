# SPDX-License-Identifier: Apache-2.0
"""Interface definitions: what a ``.msg`` or ``.srv`` says, as data."""

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
import re
from typing import Any

TABLES = Path(__file__).parent / 'tables'

INTEGERS = {'int8': 'b', 'uint8': 'B', 'int16': 'h', 'uint16': 'H', 'int32': 'i', 'uint32': 'I',
            'int64': 'q', 'uint64': 'Q'}
FLOATS = {'float32': 'f', 'float64': 'd'}
TYPECODES = {**INTEGERS, **FLOATS}  # basic types that array.array and numpy hold
SIZES = {'bool': 1, 'byte': 1, 'int8': 1, 'uint8': 1, 'int16': 2, 'uint16': 2, 'int32': 4,
         'uint32': 4, 'int64': 8, 'uint64': 8, 'float32': 4, 'float64': 8}
STRINGS = ('string', 'wstring')
PLACEHOLDER = 'structure_needs_at_least_one_member'
PRIMITIVES = {*SIZES, *STRINGS, 'char'}

_TYPE = re.compile(r'(?P<base>[A-Za-z][\w/]*)(<=(?P<text>\d+))?(\[(?P<size>(<=)?\d*)\])?$')


@dataclass(frozen=True)
class Field:
    """
    One member of a message.

    ``base`` is a primitive's name or ``package/msg/Name``; ``kind`` is '' (scalar), 'array'
    (of ``size`` elements) or 'sequence' (of at most ``size``; 0: unbounded); ``text`` bounds a
    string's length (0: unbounded).
    """

    name: str
    base: str
    kind: str = ''
    size: int = 0
    text: int = 0
    default: Any = None

    @property
    def nested(self) -> bool:
        """Whether the base is a message."""
        return '/' in self.base


@dataclass(frozen=True)
class Definition:
    """A message: its full name (``package/msg/Name``), fields and constants."""

    name: str
    fields: tuple[Field, ...] = ()
    constants: dict[str, Any] = field(default_factory=dict)


def _value(base: str, text: str) -> Any:
    """Read a constant or a default as ROS writes it."""
    text = text.strip()
    if base in STRINGS:
        quoted = len(text) > 1 and text[0] == text[-1] and text[0] in '"\''
        return text[1:-1] if quoted else text
    if base == 'bool':
        return text.lower() in ('true', '1')
    if base in FLOATS:
        return float(text)
    return int(text, 0)


def parse_field(text: str, package: str) -> Field:
    """Read ``type name [default]``; ``package`` completes a type without one."""
    kind, _, rest = text.partition(' ')
    name, _, default = rest.strip().partition(' ')
    match = _TYPE.match(kind)
    if match is None or not name:
        raise ValueError(f"'{text}' is no field of a message")
    base = match['base']
    if base == 'char':
        base = 'uint8'  # what ROS 2's interface files call char is an unsigned byte
    if base == 'Header':
        base = 'std_msgs/Header'
    if base not in PRIMITIVES:
        base = base if '/' in base else f'{package}/{base}'
        base = base if base.count('/') == 2 else base.replace('/', '/msg/')
    size = match['size']
    shape = '' if size is None else 'array' if size.isdigit() else 'sequence'
    count = int(size.replace('<=', '') or 0) if size else 0
    value = _value(base, default) if default.strip() else None
    return Field(name, base, shape, count, int(match['text'] or 0), value)


def parse_members(name: str, members: list[str]) -> Definition:
    """Build the definition of ``package/kind/Name`` from its lines."""
    package = name.split('/')[0]
    fields: list[Field] = []
    constants: dict[str, Any] = {}
    for member in members:
        head = re.match(r'(\S+)\s+([A-Z][A-Z0-9_]*)\s*=(.*)$', member)
        if head and '<=' not in head[1].rpartition(']')[2]:
            value = _value(head[1].partition('<=')[0].replace('char', 'uint8'), head[3])
            # fields of this type are bytes in Python
            constants[head[2]] = bytes([value]) if head[1] == 'byte' else value
        else:
            fields.append(parse_field(member, package))
    return Definition(name, tuple(fields), constants)


def parse_service(name: str, members: list[str]) -> dict[str, Definition]:
    """Build the definitions of a service's request, response and event."""
    split = members.index('---')
    parts = {'_Request': members[:split], '_Response': members[split + 1:]}
    parsed = {name + end: parse_members(name + end, lines) for end, lines in parts.items()}
    parsed[name + '_Event'] = Definition(name + '_Event', (
        Field('info', 'service_msgs/msg/ServiceEventInfo'),
        Field('request', name + '_Request', 'sequence', 1),
        Field('response', name + '_Response', 'sequence', 1)))
    return parsed


@lru_cache(maxsize=None)
def table(package: str) -> dict[str, str]:
    """Read a package's lines by ``kind/Name``; KeyError for an unknown package."""
    try:
        text = (TABLES / f'{package}.txt').read_text()
    except FileNotFoundError:
        raise KeyError(f"package '{package}' has no interfaces here") from None
    return dict(line.split(':', 1) for line in text.splitlines())


def names(package: str, kind: str) -> list[str]:
    """List a package's interfaces of a kind ('msg' or 'srv')."""
    return [name.split('/')[1] for name in table(package) if name.startswith(f'{kind}/')]


@lru_cache(maxsize=None)
def definition(name: str) -> Definition:
    """
    Find the definition of a message or a part of a service.

    :param name: ``package/msg/Name`` or ``package/srv/Name_Request``, ``_Response``, ``_Event``.
    :raises KeyError: if there is no such interface.
    """
    package, kind, short = name.split('/')
    lines = table(package)
    if kind == 'srv':
        service = short.rpartition('_')[0]
        members = _members(lines[f'srv/{service}'])
        return parse_service(f'{package}/srv/{service}', members)[name]
    return parse_members(name, _members(lines[f'{kind}/{short}']))


def _members(line: str) -> list[str]:
    return [member.strip() for member in line.split(' | ') if member.strip()]
