# SPDX-License-Identifier: Apache-2.0
"""Messages as YAML and dictionaries."""

import array
from collections import OrderedDict
import re
import sys
from typing import Any


def _is_many(value: Any) -> bool:
    return isinstance(value, (list, tuple, array.array)) or hasattr(value, 'ndim') and value.ndim


def _abbreviated(value: Any, kind: str) -> str:
    """Describe a field by its type, such as ``sequence<uint8, 3>`` or ``double[36]``."""
    sequence = re.fullmatch(r'sequence<([^,]+)(?:, (\d+))?>', kind)
    if sequence is None:
        return f'<array type: {kind}>'
    bound = f'[{sequence[2]}]' if sequence[2] else ''
    return f'<sequence type: {sequence[1]}{bound}, length: {len(value)}>'


def message_to_yaml(msg: Any, *, truncate_length: int | None = None, no_arr: bool = False,
                    no_str: bool = False) -> str:
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
    return str(yaml.dump(
        message_to_ordereddict(
            msg, truncate_length=truncate_length, no_arr=no_arr, no_str=no_str),
        Dumper=Dumper, allow_unicode=True, width=sys.maxsize, default_flow_style=False))


def message_to_ordereddict(msg: Any, *, truncate_length: int | None = None, no_arr: bool = False,
                           no_str: bool = False) -> 'OrderedDict[str, Any]':
    """Convert a message to a dictionary; see :func:`message_to_yaml`."""
    return OrderedDict(_convert(msg, None, truncate_length, no_arr, no_str))


def _convert(value: Any, kind: str | None, *how: Any) -> Any:
    truncate_length, no_arr, no_str = how
    if hasattr(value, 'get_fields_and_field_types'):
        return OrderedDict((name, _convert(getattr(value, name), kind, *how))
                           for name, kind in value.get_fields_and_field_types().items())
    if isinstance(value, (bytes, str)):
        if no_str and isinstance(value, str):
            return f'<string length: <{len(value)}>>'
        text = value if isinstance(value, str) else ''.join(map(chr, value))
        if truncate_length is not None and len(value) > truncate_length:
            return text[:truncate_length] + '...'
        return text
    if _is_many(value):
        if no_arr and kind is not None:
            return _abbreviated(value, kind)
        items = [_convert(item, None, *how) for item in value[:truncate_length]]
        if truncate_length is not None and len(value) > truncate_length:
            items.append('...')
        return items
    return value.item() if hasattr(value, 'item') else value
