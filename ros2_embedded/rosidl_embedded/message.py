# SPDX-License-Identifier: Apache-2.0
"""
Message classes as rosidl's generator for Python makes them.

Sequences of numbers are ``array.array``, arrays of numbers ``numpy.ndarray``, other ones lists.
Fields are checked when they are set, as ROS 2 does with ``ROS_PYTHON_CHECK_FIELDS=1``: without it
ROS 2 reads a wrong type's memory, here it would be a late error. ``check_fields=False`` and
``ROS_PYTHON_CHECK_FIELDS=0`` turn it off.
"""

import array
from collections import UserList, UserString
from collections.abc import Callable, Sequence, Set
from functools import lru_cache, partial
import math
import os
import re
from typing import Any

from rosidl_embedded.definition import Definition, definition, Field, FLOATS, INTEGERS, TYPECODES

CHECK_FIELDS = os.environ.get('ROS_PYTHON_CHECK_FIELDS', '1') == '1'
IDL_NAMES = {'bool': 'boolean', 'byte': 'octet', 'float32': 'float', 'float64': 'double'}
_LIMITS = {'float32': ('float', 3.402823466e+38), 'float64': ('double', 1.7976931348623157e+308)}


def _python_type(field: Field) -> type:
    if field.nested:
        return message_class(field.base)
    return {'bool': bool, 'byte': bytes, 'string': str, 'wstring': str}.get(
        field.base, float if field.base in FLOATS else int)


def _range(base: str) -> tuple[int, int]:
    bits = int(base.lstrip('uint'))
    return (0, 2 ** bits - 1) if base[0] == 'u' else (-2 ** (bits - 1), 2 ** (bits - 1) - 1)


def _scalar_check(field: Field) -> Callable[[Any], None]:
    """Make the check of a single value; its AssertionError is worded as rosidl's."""
    name = field.name
    if field.nested:
        short = field.base.rpartition('/')[2]

        def check(value: Any) -> None:
            assert isinstance(value, message_class(field.base)), \
                f"The '{name}' field must be a sub message of type '{short}'"
    elif field.base == 'byte':
        def check(value: Any) -> None:
            assert isinstance(value, (bytes, bytearray)) and len(value) == 1, \
                f"The '{name}' field must be of type 'bytes' or 'ByteString' with length 1"
    elif field.text:
        def check(value: Any) -> None:
            assert isinstance(value, (str, UserString)) and len(value) <= field.text, \
                f"The '{name}' field must be string value not longer than {field.text}"
    elif field.base in INTEGERS:
        low, high = _range(field.base)
        sign = 'an integer' if low else 'an unsigned integer'

        def check(value: Any) -> None:
            assert isinstance(value, int), f"The '{name}' field must be of type 'int'"
            assert low <= value <= high, f"The '{name}' field must be {sign} in [{low}, {high}]"
    elif field.base in FLOATS:
        kind, limit = _LIMITS[field.base]

        def check(value: Any) -> None:
            assert isinstance(value, float), f"The '{name}' field must be of type 'float'"
            assert not (value < -limit or value > limit) or math.isinf(value), \
                f"The '{name}' field must be a {kind} in [{-limit}, {limit}]"
    else:
        wanted = _python_type(field)

        def check(value: Any) -> None:
            assert isinstance(value, wanted), \
                f"The '{name}' field must be of type '{wanted.__name__}'"
    return check


def _many_message(field: Field) -> str:
    parts = [f"The '{field.name}' field must be a set or sequence"]
    if field.size:
        parts.append(f"with length {'<= ' if field.kind == 'sequence' else ''}{field.size}")
    if field.text:
        parts.append(f'and each string value not longer than {field.text}')
    parts.append(f"and each value of type '{_python_type(field).__name__}'")
    if field.base in INTEGERS:
        low, high = _range(field.base)
        parts.append(f"and each {'' if low else 'unsigned '}integer in [{low}, {high}]")
    elif field.base in FLOATS:
        kind, limit = _LIMITS[field.base]
        parts.append(f'and each {kind} in [{-limit:f}, {limit:f}]')
    return ' '.join(parts)


def _many_check(field: Field) -> Callable[[Any], None]:
    wanted, one = _python_type(field), _scalar_check(field)

    def check(value: Any) -> None:
        message = _many_message(field)
        assert isinstance(value, (Sequence, Set, UserList)), message
        assert not isinstance(value, (str, UserString)), message
        assert not field.size or (
            len(value) <= field.size if field.kind == 'sequence' else len(value) == field.size), \
            message
        for item in value:
            assert isinstance(item, wanted), message
            try:
                one(item)
            except AssertionError:
                raise AssertionError(message) from None
    return check


def _to_array(field: Field) -> Callable[[Any, bool], Any]:
    """Make the conversion of what is assigned to a field that holds a sequence of numbers."""
    code = TYPECODES[field.base]
    check = _many_check(field)

    def convert(value: Any, checked: bool) -> Any:
        if isinstance(value, array.array) and value.typecode == code:
            result = value
        elif isinstance(value, (bytes, bytearray)) and code == 'B':
            result = array.array('B', value)
        elif hasattr(value, 'dtype') and value.dtype.char == code and value.ndim == 1:
            result = array.array(code)
            result.frombytes(memoryview(value).cast('B') if value.flags['C_CONTIGUOUS']
                             else value.tobytes())
        else:
            if checked:
                assert not isinstance(value, array.array), (
                    f"The '{field.name}' array.array() must have the type code of '{code}'")
                check(value)
            result = array.array(code, value)
        if field.size and checked:
            assert len(result) <= field.size, \
                f"The '{field.name}' array.array() must have a size <= {field.size}"
        return result
    return convert


def _to_ndarray(field: Field) -> Callable[[Any, bool], Any]:
    """Make the conversion of what is assigned to a field that holds an array of numbers."""
    kind = {'f': 'float32', 'd': 'float64'}.get(TYPECODES[field.base], field.base)
    check = _many_check(field)

    def convert(value: Any, checked: bool) -> Any:
        import numpy
        if checked and isinstance(value, numpy.ndarray):
            assert value.dtype == kind, (
                f"The '{field.name}' numpy.ndarray() must have the dtype of 'numpy.{kind}'")
            assert value.size == field.size, (
                f"The '{field.name}' numpy.ndarray() must have a size of {field.size}")
            return value
        if checked:
            check(value)
        return numpy.array(value, dtype=kind)
    return convert


def _property(field: Field) -> property:
    slot = '_' + field.name

    def getter(self: Any) -> Any:
        return getattr(self, slot)

    if field.kind and field.base in TYPECODES:
        convert = _to_array(field) if field.kind == 'sequence' else _to_ndarray(field)

        def setter(self: Any, value: Any) -> None:
            setattr(self, slot, convert(value, self._check_fields))
    else:
        check = _many_check(field) if field.kind else _scalar_check(field)

        def setter(self: Any, value: Any) -> None:
            if self._check_fields:
                check(value)
            setattr(self, slot, value)
    return property(getter, setter, doc=f"Message field '{field.name}'.")


def _default(field: Field) -> Callable[[], Any]:
    """Make what makes a field's default value."""
    if field.kind == 'sequence':
        return partial(array.array, TYPECODES[field.base]) if field.base in TYPECODES else list
    if field.kind and field.base in TYPECODES:
        import numpy
        zeros: Any = numpy.zeros
        return partial(zeros, field.size, dtype=field.base)
    plain = b'\0' if field.base == 'byte' else field.default
    single: Callable[[], Any] = _python_type(field) if plain is None else (lambda: plain)
    return (lambda: [single() for _ in range(field.size)]) if field.kind else single


def _constructor(described: Definition) -> Callable[..., None]:
    defaults = [('_' + field.name, _default(field)) for field in described.fields]

    def __init__(self: Any, **kwargs: Any) -> None:
        self._check_fields = kwargs.pop('check_fields', CHECK_FIELDS)
        for slot, default in defaults:
            setattr(self, slot, default())
        if kwargs:
            _assign(self, kwargs)
    __init__.__qualname__ = f"{described.name.rpartition('/')[2]}.__init__"
    return __init__


def _assign(message: Any, values: dict[str, Any]) -> None:
    known = message._fields_and_field_types
    if message._check_fields:
        unknown = sorted(name for name in values if name not in known)
        assert not unknown, f"Invalid arguments passed to constructor: {', '.join(unknown)}"
    for name, value in values.items():
        if name in known:
            setattr(message, name, value)


def _repr(self: Any) -> str:
    parts = []
    for field in self._definition.fields:
        value = getattr(self, '_' + field.name)
        if field.kind == 'sequence' and isinstance(value, array.array):
            value = value.tolist()
        parts.append(f'{field.name}={value!r}')
    package = self.__module__.rpartition('.')[0]
    return f"{package}.{type(self).__name__}({', '.join(parts)})"


def _restore(name: str, values: list[Any]) -> Any:
    """Make a message anew; for pickle and copy."""
    cls: Any = message_class(name)
    message = cls.__new__(cls)
    for slot, value in zip(cls.__slots__, values):
        setattr(message, slot, value)
    return message


def _reduce(self: Any) -> tuple[Any, ...]:
    return _restore, (self._definition.name, [getattr(self, slot) for slot in self.__slots__])


def _module(name: str) -> str:
    """Name the module in which rosidl puts a class: ``package.kind._snake_case``."""
    package, kind, short = name.split('/')
    short = re.sub(r'_(Request|Response|Event)$', '', short) if kind == 'srv' else short
    snake = re.sub(r'([A-Z]+)([A-Z][a-z])', r'\1_\2', short)
    snake = re.sub(r'([a-z0-9])([A-Z])', r'\1_\2', snake).lower()
    return f'{package}.{kind}._{snake}'


def _equal(self: Any, other: Any) -> bool:
    if not isinstance(other, type(self)):
        return False
    for slot in self.__slots__[:-1]:
        ours, theirs = getattr(self, slot), getattr(other, slot)
        if hasattr(ours, 'dtype') or hasattr(theirs, 'dtype'):
            if len(ours) != len(theirs) or not all(ours == theirs):
                return False
        elif ours != theirs:
            return False
    return True


def type_text(field: Field) -> str:
    """Write a field's type as ``get_fields_and_field_types()`` gives it."""
    base = field.base.replace('/msg/', '/').replace('/srv/', '/')
    text = IDL_NAMES.get(base, base)
    if field.text:
        text += f'<{field.text}>'
    if field.kind == 'sequence':
        return f'sequence<{text}, {field.size}>' if field.size else f'sequence<{text}>'
    return f'{text}[{field.size}]' if field.kind else text


@lru_cache(maxsize=None)
def message_class(name: str) -> type:
    """
    Give the class of a message.

    :param name: ``package/msg/Name``, or a part of a service (``package/srv/Name_Request``).
    :raises KeyError: if there is no such message.
    """
    described = definition(name)
    package, kind, short = name.split('/')
    fields_and_types = {field.name: type_text(field) for field in described.fields}
    body: dict[str, Any] = {
        '__module__': _module(name),
        '__slots__': ['_' + field.name for field in described.fields] + ['_check_fields'],
        '__doc__': f"Message class '{short}'.",
        '__init__': _constructor(described),
        '__repr__': _repr,
        '__reduce__': _reduce,
        '__eq__': _equal,
        '__hash__': None,
        '_definition': described,
        '_fields_and_field_types': fields_and_types,
        'get_fields_and_field_types': classmethod(lambda cls: dict(cls._fields_and_field_types)),
        **described.constants,
    }
    for field in described.fields:
        body[field.name] = _property(field)
        if field.default is not None:
            body[f'{field.name.upper()}__DEFAULT'] = field.default
    return type(short, (), body)


class _Service(type):
    """The class of services' classes: builds Request, Response and Event when asked for."""

    def __getattr__(cls, name: str) -> Any:
        if name in ('Request', 'Response', 'Event') and '_service' in vars(cls):
            part = message_class(f'{cls._service}_{name}')
            setattr(cls, name, part)
            return part
        raise AttributeError(f"type object '{cls.__name__}' has no attribute '{name}'")


@lru_cache(maxsize=None)
def service_class(name: str) -> type:
    """
    Give the class of a service, with Request, Response and Event.

    :param name: ``package/srv/Name``.
    :raises KeyError: if there is no such service.
    """
    package, kind, short = name.split('/')
    definition(f'{name}_Request')

    def refuse(self: Any) -> None:
        raise NotImplementedError('Service classes can not be instantiated')

    return _Service(short, (), {
        '__module__': _module(name),
        '__doc__': f"Service class '{short}'.",
        '__init__': refuse,
        '_service': name,
    })


def validate(message: Any) -> None:
    """
    Check all fields of a message and of those it holds.

    :raises AssertionError: in rosidl's words, for the first field that holds what it mustn't.
    """
    for field in message._definition.fields:
        value = getattr(message, field.name)
        if field.kind and field.base in TYPECODES:
            (_to_array(field) if field.kind == 'sequence' else _to_ndarray(field))(value, True)
            continue
        (_many_check(field) if field.kind else _scalar_check(field))(value)
        if field.nested:
            for item in value if field.kind else [value]:
                validate(item)
