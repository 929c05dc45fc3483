# SPDX-License-Identifier: Apache-2.0
"""Messages from dictionaries."""

from typing import Any

from rosidl_embedded.message import message_class


def set_message_fields(msg: Any, values: dict[str, Any]) -> None:
    """
    Set fields of a message.

    :param values: by the fields' names.
    :raises AttributeError: if the message hasn't such a field.
    :raises TypeError: if a value isn't of the field's type.
    """
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
