# SPDX-License-Identifier: Apache-2.0
"""RIHS01 type hashes (REP-2011): SHA-256 of a type description as JSON."""

from functools import lru_cache
import hashlib
import json
from typing import Any

from rosidl_embedded.definition import Definition, definition, Field, PLACEHOLDER

# type_description_interfaces/msg/FieldType: the plain ids, and what arrays add to them
_IDS = {'int8': 2, 'uint8': 3, 'int16': 4, 'uint16': 5, 'int32': 6, 'uint32': 7, 'int64': 8,
        'uint64': 9, 'float32': 10, 'float64': 11, 'bool': 15, 'byte': 16, 'string': 17,
        'wstring': 18}
_NESTED = 1
_ARRAY, _BOUNDED, _UNBOUNDED = 48, 96, 144
_BOUNDED_STRING = 4  # what a bound adds to a string's id: 17 -> 21, 18 -> 22


def _field(field: Field) -> dict[str, Any]:
    number = _NESTED if field.nested else _IDS[field.base]
    if field.text:
        number += _BOUNDED_STRING
    if field.kind == 'array':
        number += _ARRAY
    elif field.kind == 'sequence':
        number += _BOUNDED if field.size else _UNBOUNDED
    return {'name': field.name, 'type': {
        'type_id': number, 'capacity': field.size, 'string_capacity': field.text,
        'nested_type_name': field.base if field.nested else ''}}


def _describe(described: Definition, found: dict[str, Any]) -> dict[str, Any]:
    fields = described.fields or (Field(PLACEHOLDER, 'uint8'),)
    for field in fields:
        if field.nested and field.base not in found:
            found[field.base] = None
            found[field.base] = _describe(definition(field.base), found)
    return {'type_name': described.name, 'fields': [_field(field) for field in fields]}


def describe(name: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """
    Describe a message, a service or a part of one, and the messages it refers to.

    :param name: ``package/msg/Name``, ``package/srv/Name`` or ``package/srv/Name_Request``.
    :raises KeyError: if there is no such type.
    """
    found: dict[str, Any] = {}
    package, kind, short = name.split('/')
    if kind == 'srv' and not short.endswith(('_Request', '_Response', '_Event')):
        described = Definition(name, tuple(
            Field(f'{part}_message', f'{name}_{part.capitalize()}')
            for part in ('request', 'response', 'event')))
    else:
        described = definition(name)
    top = _describe(described, found)
    return top, [found[other] for other in sorted(found) if other != name]


@lru_cache(maxsize=None)
def type_hash(name: str) -> str:
    """
    Hash what :func:`describe` describes.

    :returns: ``RIHS01_`` and 64 hexadecimal digits.
    """
    top, others = describe(name)
    text = json.dumps({'type_description': top, 'referenced_type_descriptions': others})
    return 'RIHS01_' + hashlib.sha256(text.encode()).hexdigest()
