# SPDX-License-Identifier: Apache-2.0
"""Messages from dictionaries."""

import re
from typing import Any

from rosidl_runtime_py.utilities import get_message

#: A field's type: package/Name alone, in an array ``[3]``, or in a sequence ``<..., 3>``.
_MANY = re.compile(r'sequence<([^,>]+)(?:, \d+)?>|(.+)\[\d+\]')


def set_message_fields(msg: Any, values: dict[str, Any]) -> None:
    """
    Set fields of a message.

    :param values: by the fields' names.
    :raises AttributeError: the message has no such field.
    :raises TypeError: a value is not of the field's type.
    """
    if not hasattr(values, 'items'):
        raise TypeError(f"Value '{values}' is expected to be a dictionary but is a "
                        f'{type(values).__name__}')
    types = msg.get_fields_and_field_types()
    for name, value in values.items():
        current = getattr(msg, name)
        many = _MANY.fullmatch(types[name])
        base = (many[1] or many[2]) if many else types[name]
        if many and '/' in base:
            value = [_made(base, item) for item in value]
        elif many and base in ('float', 'double'):
            value = [float(item) for item in value]
        elif many and base == 'octet':
            value = [item if isinstance(item, bytes) else bytes([item]) for item in value]
        elif '/' in base:
            set_message_fields(current, value)
            continue
        elif not many and base == 'octet':
            value = value if isinstance(value, bytes) else bytes([value])
        elif not many and not isinstance(value, type(current)):
            value = type(current)(value)
        setattr(msg, name, value)


def _made(base: str, values: dict[str, Any]) -> Any:
    message = get_message(base)()
    set_message_fields(message, values)
    return message
