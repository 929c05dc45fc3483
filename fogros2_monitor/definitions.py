# SPDX-License-Identifier: Apache-2.0
"""
Generate message definitions as text, in the format ``ros2msg`` of ROS 2 bags and Foxglove.

The definitions come from the installed message classes, so they are right for any version of the
interfaces and need no ``.msg`` file.
"""

from __future__ import annotations

import re
from typing import Any

from fogros2 import ros_types

_RULE = '=' * 80
#: Name and definition of what shows an H.264 stream to viewers, which few computers have.
VIDEO = ('foxglove_msgs/msg/CompressedVideo', (
    'builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n'
    f'{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n'))
#: Types of IDL in message classes, and the same types in message files.
_BASIC = {
    'boolean': 'bool', 'octet': 'byte', 'float': 'float32', 'double': 'float64',
    **{name: name for name in (
        'bool', 'byte', 'char', 'float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32',
        'uint32', 'int64', 'uint64', 'string', 'wstring')},
}
_SEQUENCE = re.compile(r'sequence<(?P<item>.+?)(?:, (?P<bound>\d+))?>$')
_ARRAY = re.compile(r'(?P<item>.+)\[(?P<size>\d+)\]$')
_BOUNDED = re.compile(r'(?P<kind>w?string)<(?P<bound>\d+)>$')


def definition(name: str, cls: Any = None) -> str:
    """
    Return a message's fields, followed by the fields of all nested messages.

    Each section after the first begins with a line of 80 equals signs and
    ``MSG: package/Name``, as ``ros2msg`` requires.

    :param name: type name, such as ``std_msgs/msg/String``.
    :param cls: the class, for the request or response of a service.
    :raises LookupError: the message or a nested message is not installed here.
    """
    waiting = [name]
    seen: dict[str, str] = {}
    while waiting:
        this = waiting.pop(0)
        short = _short(this)
        if short in seen:
            continue
        lines = []
        kinds = (cls if this == name and cls else ros_types.message(this))
        for field, kind in kinds.get_fields_and_field_types().items():
            written, inner = _written(kind)
            if '/' in inner:
                waiting.append(inner)
            lines.append(f'{written} {field}\n')
        seen[short] = ''.join(lines)
    (_, first), *others = seen.items()
    return first + ''.join(f'{_RULE}\nMSG: {short}\n{body}' for short, body in others)


def _short(name: str) -> str:
    return name.replace('/msg/', '/')


def _written(kind: str) -> tuple[str, str]:
    """Return a field's type as message files write it, and its item type."""
    for pattern, brackets in ((_SEQUENCE, '[<={bound}]'), (_ARRAY, '[{size}]')):
        match = pattern.match(kind)
        if match:
            item, inner = _written(match['item'])
            bounds = match.groupdict()
            unbounded = pattern is _SEQUENCE and bounds['bound'] is None
            return item + ('[]' if unbounded else brackets.format(**bounds)), inner
    bounded = _BOUNDED.match(kind)
    if bounded:
        return f'{bounded["kind"]}<={bounded["bound"]}', bounded['kind']
    if '/' in kind:
        return _short(kind), kind
    return _BASIC[kind], kind
