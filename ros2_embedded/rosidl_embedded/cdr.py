# SPDX-License-Identifier: Apache-2.0
"""
Serialisation: XCDR1 as ROS 2's middlewares write it (OMG formal/02-06-51, little endian).

A type's codec is two functions: one appends a value to a bytearray, the other reads one from a
buffer. A message's is made of its fields'. Positions count from the encapsulation header's end,
which is at 4.
"""

import array
from collections.abc import Callable
from functools import lru_cache
import struct
from typing import Any, NamedTuple

from rosidl_embedded.definition import definition, Field, SIZES, TYPECODES

HEADER = b'\x00\x01\x00\x00'  # encapsulation: CDR, little endian, no options
PADDING = tuple(bytes(count) for count in range(8))


class TruncatedError(ValueError):
    """The bytes end before the message does."""


class Codec(NamedTuple):
    """How a type is written, and read: a value and the position after it."""

    write: Callable[[bytearray, Any], None]
    read: Callable[[Any, int], tuple[Any, int]]


def _end(buffer: Any, start: int, size: int) -> int:
    if size > len(buffer) - start:
        raise TruncatedError('the serialized message is too short')
    return start + size


def _primitives(code: str, size: int) -> Codec:
    """Make the codec of neighbours of one size; of a single one if the code has one letter."""
    layout = struct.Struct('<' + code)
    pack, unpack, mask, total = layout.pack, layout.unpack_from, size - 1, layout.size

    def write(buffer: bytearray, value: Any) -> None:
        buffer += PADDING[(4 - len(buffer)) & mask] + pack(value)

    def read(buffer: Any, place: int) -> tuple[Any, int]:
        place += (4 - place) & mask
        return unpack(buffer, place)[0], place + total

    def write_all(buffer: bytearray, values: Any) -> None:
        buffer += PADDING[(4 - len(buffer)) & mask] + pack(*values)

    def read_all(buffer: Any, place: int) -> tuple[Any, int]:
        place += (4 - place) & mask
        return unpack(buffer, place), place + total

    return Codec(write, read) if len(code) == 1 else Codec(write_all, read_all)


_CODES = {**TYPECODES, 'bool': '?', 'byte': 'c'}
_COUNT = _primitives('I', 4)


def _write_string(buffer: bytearray, value: str) -> None:
    text = value.encode()
    _COUNT.write(buffer, len(text) + 1)
    buffer += text
    buffer.append(0)


def _read_string(buffer: Any, place: int) -> tuple[str, int]:
    count, place = _COUNT.read(buffer, place)
    end = _end(buffer, place, count)
    return str(buffer[place:max(end - 1, place)], 'utf-8', 'replace'), end


def _write_wide(buffer: bytearray, value: str) -> None:
    units = array.array('H', value.encode('utf-16-le'))
    _COUNT.write(buffer, len(units))
    buffer += array.array('I', units)  # rmw_cyclonedds spends 4 bytes on each


def _read_wide(buffer: Any, place: int) -> tuple[str, int]:
    count, place = _COUNT.read(buffer, place)
    end = _end(buffer, place, 4 * count)
    wide = array.array('I', bytes(buffer[place:end]))
    units = array.array('H', [unit & 0xffff for unit in wide])
    return str(units.tobytes(), 'utf-16-le', 'replace'), end


_SINGLE = {'string': Codec(_write_string, _read_string), 'wstring': Codec(_write_wide, _read_wide),
           **{base: _primitives(code, SIZES[base]) for base, code in _CODES.items()}}


def _to_octets(field: Field) -> Callable[[Any], Any]:
    if field.base == 'bool':
        return bytes
    if field.base == 'byte':
        return b''.join
    if field.kind == 'sequence':
        return lambda value: value  # array.array is a buffer
    return lambda value: value.tobytes()


def _from_octets(field: Field) -> Callable[[Any], Any]:
    if field.base == 'bool':
        return lambda data: list(map(bool, data))
    if field.base == 'byte':
        return lambda data: [bytes((octet,)) for octet in data]
    code = TYPECODES[field.base]
    if field.kind == 'array':
        import numpy
        return lambda data: numpy.frombuffer(data, '<' + code).copy()

    def load(data: Any) -> Any:
        values = array.array(code)
        values.frombytes(data)
        return values
    return load


def _many(field: Field, single: Codec) -> Codec:
    """Make the codec of an array or a sequence."""
    counted, size = field.kind == 'sequence', SIZES.get(field.base, 0)

    def count_at(buffer: Any, place: int) -> tuple[int, int]:
        return _COUNT.read(buffer, place) if counted else (field.size, place)

    def write(buffer: bytearray, values: Any) -> None:
        if counted:
            _COUNT.write(buffer, len(values))
        for value in values:
            single.write(buffer, value)

    def read(buffer: Any, place: int) -> tuple[Any, int]:
        count, place = count_at(buffer, place)
        _end(buffer, place, count)  # each takes a byte at the least
        values = []
        for _ in range(count):
            value, place = single.read(buffer, place)
            values.append(value)
        return values, place

    if not size:
        return Codec(write, read)
    to_octets, from_octets = _to_octets(field), _from_octets(field)

    def write_octets(buffer: bytearray, values: Any) -> None:
        if counted:
            _COUNT.write(buffer, len(values))
        if len(values):
            buffer += PADDING[(4 - len(buffer)) & (size - 1)]
            buffer += to_octets(values)

    def read_octets(buffer: Any, place: int) -> tuple[Any, int]:
        count, place = count_at(buffer, place)
        if count:
            place += (4 - place) & (size - 1)
        end = _end(buffer, place, count * size)
        return from_octets(buffer[place:end]), end

    return Codec(write_octets, read_octets)


def _field(field: Field) -> Codec:
    single = message_codec(field.base) if field.nested else _SINGLE[field.base]
    return _many(field, single) if field.kind else single


@lru_cache(maxsize=None)
def message_codec(name: str) -> Codec:
    """
    Give the codec of a message.

    It raises :class:`TruncatedError` or ``struct.error`` where the buffer ends too early.
    """
    from rosidl_embedded.message import CHECK_FIELDS, message_class
    fields = definition(name).fields
    cls: Any = message_class(name)
    slots = ['_' + field.name for field in fields]
    sizes = {0 if field.kind else SIZES.get(field.base, 0) for field in fields}
    if len(fields) > 1 and len(sizes) == 1 and 0 not in sizes:  # as a vector's: all at once
        together = _primitives(''.join(_CODES[field.base] for field in fields), sizes.pop())

        def write(buffer: bytearray, message: Any) -> None:
            together.write(buffer, [getattr(message, slot) for slot in slots])

        def read(buffer: Any, place: int) -> tuple[Any, int]:
            message: Any = cls.__new__(cls)
            message._check_fields = CHECK_FIELDS
            values, place = together.read(buffer, place)
            for slot, value in zip(slots, values):
                setattr(message, slot, value)
            return message, place

        return Codec(write, read)
    parts = [(slot, *_field(field)) for slot, field in zip(slots, fields)]

    def write_parts(buffer: bytearray, message: Any) -> None:
        for slot, write, _ in parts:
            write(buffer, getattr(message, slot))
        if not parts:
            buffer.append(0)  # a structure needs at least one member

    def read_parts(buffer: Any, place: int) -> tuple[Any, int]:
        message: Any = cls.__new__(cls)
        message._check_fields = CHECK_FIELDS
        for slot, _, read in parts:
            value, place = read(buffer, place)
            setattr(message, slot, value)
        return message, place + (not parts)

    return Codec(write_parts, read_parts)


def serialize(message: Any, prefix: bytes = HEADER) -> bytearray:
    """
    Serialize a message.

    :param prefix: what precedes it: the encapsulation header, for a service also the request's;
        a multiple of 8 bytes, and 4.
    :raises AssertionError: in ROS 2's words, if a field holds what it mustn't.
    """
    buffer = bytearray(prefix)
    try:
        message_codec(message._definition.name).write(buffer, message)
    except (struct.error, AttributeError, TypeError, ValueError, IndexError) as error:
        from rosidl_embedded.message import validate
        validate(message)
        raise AssertionError(f'{message!r} cannot be serialized: {error}') from error
    return buffer


def deserialize(buffer: Any, cls: type, position: int = 4) -> Any:
    """
    Deserialize a message.

    :param buffer: bytes or a memoryview of bytes, the encapsulation header first.
    :raises ValueError: if the bytes are no such message.
    """
    if len(buffer) < 4 or buffer[0] != 0 or buffer[1] != 1:
        raise ValueError('not a little-endian CDR message')
    name = cls._definition.name  # type: ignore[attr-defined]
    try:
        return message_codec(name).read(buffer, position)[0]
    except struct.error as error:
        raise TruncatedError(f'the serialized {name} is too short') from error
