# SPDX-License-Identifier: Apache-2.0
"""Messages from dictionaries."""

from collections.abc import Callable
from functools import partial
from typing import Any

from rosidl_embedded.message import message_class


def set_message_fields(msg: Any, values: dict[str, Any], expand_header_auto: bool = False,
                       expand_time_now: bool = False) -> list[Callable[[Any], None]]:
    """
    Set fields of a message.

    :param values: by the fields' names.
    :param expand_header_auto: a header that is 'auto' gets its time later.
    :param expand_time_now: a time that is 'now' is set later.
    :returns: functions that set these times.
    :raises AttributeError: if the message hasn't such a field.
    :raises TypeError: if a value isn't of the field's type.
    """
    setters: list[Callable[[Any], None]] = []

    def fill(message: Any, given: Any) -> None:
        if not hasattr(given, 'items'):
            raise TypeError(f"Value '{given}' is expected to be a dictionary but is a "
                            f'{type(given).__name__}')
        known = {field.name: field for field in message._definition.fields}
        for name, value in given.items():
            current = getattr(message, name)
            field = known[name]
            if field.kind and field.nested:
                value = [made(field.base, item) for item in value]
            elif field.nested:
                if field.base == 'std_msgs/msg/Header' and value == 'auto' and expand_header_auto:
                    setters.append(partial(setattr, current, 'stamp'))
                    continue
                if field.base == 'builtin_interfaces/msg/Time' and value == 'now' \
                        and expand_time_now:
                    setters.append(partial(setattr, message, name))
                    continue
                fill(current, value)
                continue
            elif not field.kind and not isinstance(value, type(current)):
                value = type(current)(value)
            elif field.kind and field.base in ('float32', 'float64'):
                value = [float(item) for item in value]
            setattr(message, name, value)

    def made(base: str, given: Any) -> Any:
        message = message_class(base)()
        fill(message, given)
        return message

    fill(msg, values)
    return setters
