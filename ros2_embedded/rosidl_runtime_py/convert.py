# SPDX-License-Identifier: Apache-2.0
"""Messages as YAML, CSV and dictionaries."""

import array
from collections import OrderedDict
import sys
from typing import Any

from rosidl_embedded.definition import Field


def _is_many(value: Any) -> bool:
    return isinstance(value, (list, tuple, array.array)) or hasattr(value, 'ndim') and value.ndim


def _abbreviated(value: Any, field: Field) -> str:
    base = {'byte': 'octet', 'float32': 'float', 'float64': 'double'}.get(field.base, field.base)
    if field.kind == 'array':
        return f'<array type: {base}[{field.size}]>'
    bound = f'[{field.size}]' if field.size else ''
    return f'<sequence type: {base}{bound}, length: {len(value)}>'


def message_to_yaml(msg: Any, *, truncate_length: int | None = None, no_arr: bool = False,
                    no_str: bool = False, flow_style: bool = False) -> str:
    """
    Write a message as YAML.

    :param truncate_length: write no more than this many elements or characters of anything.
    :param no_arr: write what a sequence is instead of what it holds.
    :param no_str: write a string's length instead of it.
    """
    import yaml

    class Dumper(yaml.Dumper):
        def ignore_aliases(self, data: Any) -> bool:
            return True

    Dumper.add_representer(OrderedDict, lambda dumper, data: dumper.represent_mapping(
        'tag:yaml.org,2002:map', data.items()))
    text: str = yaml.dump(
        message_to_ordereddict(
            msg, truncate_length=truncate_length, no_arr=no_arr, no_str=no_str),
        Dumper=Dumper, allow_unicode=True, width=sys.maxsize, default_flow_style=flow_style)
    return text


def message_to_csv(msg: Any, *, truncate_length: int | None = None, no_arr: bool = False,
                   no_str: bool = False) -> str:
    """Write all a message holds, separated by commas; see :func:`message_to_yaml`."""
    def text(value: Any, field: Field | None) -> str:
        if _is_many(value):
            if no_arr and field is not None:
                return _abbreviated(value, field)
            items = [text(item, None) for item in value[:truncate_length]]
            if truncate_length is not None and len(value) > truncate_length:
                items.append('...')
            return ','.join(items)
        if hasattr(value, '_definition'):
            return message_to_csv(
                value, truncate_length=truncate_length, no_arr=no_arr, no_str=no_str)
        if no_str and isinstance(value, str):
            return f'<string length: <{len(value)}>>'
        if isinstance(value, (str, bytes)) and truncate_length is not None \
                and len(value) > truncate_length:
            dots: Any = '...' if isinstance(value, str) else b'...'
            value = value[:truncate_length] + dots
        return str(value)

    return ','.join(text(getattr(msg, field.name), field) for field in msg._definition.fields)


def message_to_ordereddict(msg: Any, *, truncate_length: int | None = None, no_arr: bool = False,
                           no_str: bool = False) -> 'OrderedDict[str, Any]':
    """Convert a message to a dictionary; see :func:`message_to_yaml`."""
    def convert(value: Any, field: Field | None) -> Any:
        if isinstance(value, (bytes, str)):
            text = value if isinstance(value, str) else ''.join(map(chr, value))
            if no_str and isinstance(value, str):
                return f'<string length: <{len(text)}>>'
            if truncate_length is not None and len(text) > truncate_length:
                return text[:truncate_length] + '...'
            return text
        if _is_many(value):
            if no_arr and field is not None:
                return _abbreviated(value, field)
            items = [convert(item, None) for item in value[:truncate_length]]
            if truncate_length is not None and len(value) > truncate_length:
                items.append('...')
            return items
        if hasattr(value, '_definition'):
            return message_to_ordereddict(
                value, truncate_length=truncate_length, no_arr=no_arr, no_str=no_str)
        return value.item() if hasattr(value, 'item') else value

    return OrderedDict((field.name, convert(getattr(msg, field.name), field))
                       for field in msg._definition.fields)
