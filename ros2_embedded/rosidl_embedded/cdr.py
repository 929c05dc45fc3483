# SPDX-License-Identifier: Apache-2.0
"""
Serialisation: XCDR1 as ROS 2's middlewares write it (OMG formal/02-06-51, little endian).

For each message two functions are generated. Nested messages are inlined and neighbouring
primitives share one ``struct``; what is known of the position modulo 8 says at generation time
how much padding there is, else it is computed.
"""

import array
from collections.abc import Callable
from functools import lru_cache
import struct
from typing import Any

from rosidl_embedded.definition import Definition, Field, SIZES, TYPECODES

HEADER = b'\x00\x01\x00\x00'  # encapsulation: CDR, little endian, no options
PADDING = tuple(bytes(count) for count in range(8))

_FORMATS = {**TYPECODES, 'bool': '?', 'byte': 'B'}


class TruncatedError(ValueError):
    """The bytes end before the message does."""


def _short() -> None:
    raise TruncatedError('the serialized message is too short')


class _Generator:
    """Lines of one function, with what is known of the position in the stream."""

    def __init__(self, head: str) -> None:
        self.lines = [head]
        self.names: dict[str, Any] = {'PADDING': PADDING, 'array': array.array, 'short': _short}
        self.depth = 1
        self.modulus, self.offset = 8, 0
        self.format, self.items = '', list[str]()
        self.after = list[str]()
        self.count = 0

    def name(self, stem: str) -> str:
        self.count += 1
        return f'{stem}{self.count}'

    def put(self, line: str) -> None:
        self.lines.append('  ' * self.depth + line)

    def forget(self, modulus: int = 1) -> None:
        """From here on the position is known to be a multiple of modulus, and no more."""
        self.modulus, self.offset = modulus, 0

    def align(self, size: int) -> None:
        if size > self.modulus:
            self.flush()
            self.pad(size)
            self.forget(size)
        elif missing := -self.offset % size:
            self.format += f'{missing}x'
            self.offset = (self.offset + missing) % self.modulus

    def primitive(self, code: str, size: int, item: str) -> None:
        self.align(size)
        self.format += code
        self.items.append(item)
        self.offset = (self.offset + size) % self.modulus

    def pad(self, size: int) -> None:
        raise AssertionError

    def flush(self) -> None:
        raise AssertionError

    def struct(self) -> str:
        """Name the struct of the run so far and start a new run."""
        name = self.name('s')
        self.names[name] = struct.Struct('<' + self.format)
        self.format, self.items = '', []
        return name

    def finish(self, name: str) -> Callable[..., Any]:
        code = compile('\n'.join(self.lines), f'<cdr of {name}>', 'exec')
        exec(code, self.names)  # noqa: S102 - generated above, from our own tables
        function: Callable[..., Any] = self.names['function']
        return function


class _Writer(_Generator):
    """Generates ``function(m, b)``, which appends message m to bytearray b."""

    def pad(self, size: int) -> None:
        self.put(f'b += PADDING[(4 - len(b)) & {size - 1}]')

    def flush(self) -> None:
        if self.format:
            items = ', '.join(self.items)
            self.put(f'b += {self.struct()}.pack({items})')

    def message(self, definition: Definition, source: str) -> None:
        from rosidl_embedded.definition import definition as find
        if not definition.fields:
            self.primitive('B', 1, '0')
        for field in definition.fields:
            value = f'{source}._{field.name}'
            if field.kind:
                self.many(field, value)
            elif field.nested:
                self.message(find(field.base), value)
            else:
                self.scalar(field, value)

    def scalar(self, field: Field, value: str) -> None:
        if field.base == 'string':
            text = self.name('t')
            self.put(f'{text} = {value}.encode()')
            self.primitive('I', 4, f'len({text}) + 1')
            self.flush()
            self.put(f'b += {text}')
            self.put('b.append(0)')
            self.forget()
        elif field.base == 'wstring':
            text = self.name('t')
            self.put(f"{text} = {value}.encode('utf-16-le')")
            self.primitive('I', 4, f'len({text}) // 2')
            self.flush()
            self.put(f'b += {text}')
            self.forget(2)
        elif field.base == 'byte':
            self.primitive('B', 1, f'{value}[0]')
        else:
            self.primitive(_FORMATS[field.base], SIZES[field.base], value)

    def many(self, field: Field, value: str) -> None:
        if field.kind == 'sequence':
            self.primitive('I', 4, f'len({value})')
        if field.base not in SIZES:
            self.loop(field, value)
            return
        size = SIZES[field.base]
        if field.kind == 'array':
            self.align(size)
            self.flush()
        else:
            self.flush()
            if size > 4:
                self.put(f'if {value}: b += PADDING[(4 - len(b)) & {size - 1}]')
        if field.base == 'bool':
            self.put(f'b += bytes({value})')
        elif field.base == 'byte':
            self.put(f"b += b''.join({value})")
        elif field.kind == 'array':
            self.put(f'b += {value}.tobytes()')
        else:
            self.put(f'b += {value}')
        if field.kind == 'array':
            self.offset = (self.offset + size * field.size) % self.modulus
        else:
            self.forget(min(size, 4))

    def loop(self, field: Field, value: str) -> None:
        self.flush()
        item = self.name('x')
        self.put(f'for {item} in {value}:')
        self.depth += 1
        self.forget()
        if field.nested:
            from rosidl_embedded.definition import definition as find
            self.message(find(field.base), item)
        else:
            self.scalar(field, item)
        self.flush()
        self.depth -= 1
        self.forget()


class _Reader(_Generator):
    """Generates ``function(b, p)``: a message from buffer b at p, and the position after it."""

    def __init__(self, head: str, class_of: Callable[[str], type]) -> None:
        super().__init__(head)
        self.class_of = class_of

    def pad(self, size: int) -> None:
        self.put(f'p += (4 - p) & {size - 1}')

    def flush(self) -> None:
        if self.format:
            items, size = self.items, struct.calcsize('<' + self.format)
            name = self.struct()
            if items:
                self.put(f"{', '.join(items)}, = {name}.unpack_from(b, p)")
            self.put(f'p += {size}')
        self.lines += ['  ' * self.depth + line for line in self.after]
        self.after = []

    def new(self, definition: Definition, target: str) -> None:
        cls = self.class_of(definition.name)
        name = f'C{cls.__name__}_{len(self.names)}'
        self.names[name] = cls
        self.put(f'{target} = {name}.__new__({name})')
        self.put(f'{target}._check_fields = CHECK')

    def message(self, definition: Definition, target: str) -> None:
        from rosidl_embedded.definition import definition as find
        self.new(definition, target)
        if not definition.fields:
            self.primitive('B', 1, '_')
        for field in definition.fields:
            place = f'{target}._{field.name}'
            if field.kind:
                self.many(field, place)
            elif field.nested:
                inner = self.name('m')
                self.message(find(field.base), inner)
                self.put(f'{place} = {inner}')
            else:
                self.scalar(field, place)

    def scalar(self, field: Field, place: str) -> None:
        if field.base in ('string', 'wstring'):
            count = self.name('n')
            self.primitive('I', 4, count)
            self.flush()
            width = 1 if field.base == 'string' else 2
            self.put(f'e = p + {count} * {width}')
            self.put('if e > z: short()')
            if width == 1:
                self.put(f"{place} = str(b[p:e - 1], 'utf-8', 'replace') if {count} else ''")
            else:
                self.put(f"{place} = str(b[p:e], 'utf-16-le', 'replace')")
            self.put('p = e')
            self.forget(width)
        elif field.base == 'byte':
            item = self.name('t')
            self.primitive('B', 1, item)
            self.after.append(f'{place} = bytes(({item},))')
        else:
            self.primitive(_FORMATS[field.base], SIZES[field.base], place)

    def many(self, field: Field, place: str) -> None:
        if field.kind == 'sequence':
            count = self.name('n')
            self.primitive('I', 4, count)
            self.flush()
        else:
            count = str(field.size)
        if field.base not in SIZES:
            self.flush()
            self.loop(field, place, count)
            return
        size = SIZES[field.base]
        if field.kind == 'array':
            self.align(size)
            self.flush()
        elif size > 4:
            self.put(f'if {count}: p += (4 - p) & {size - 1}')
        self.put(f'e = p + {count} * {size}')
        self.put('if e > z: short()')
        if field.base == 'bool':
            self.put(f'{place} = list(map(bool, b[p:e]))')
        elif field.base == 'byte':
            self.put(f'{place} = [bytes((x,)) for x in b[p:e]]')
        elif field.kind == 'array':
            import numpy
            self.names['frombuffer'] = numpy.frombuffer
            code = TYPECODES[field.base]
            self.put(f"{place} = frombuffer(b[p:e], '<{code if size > 1 else code}').copy()")
        else:
            self.put(f"{place} = v = array('{TYPECODES[field.base]}')")
            self.put('v.frombytes(b[p:e])')
        self.put('p = e')
        if field.kind == 'array':
            self.offset = (self.offset + size * field.size) % self.modulus
        else:
            self.forget(min(size, 4))

    def loop(self, field: Field, place: str, count: str) -> None:
        items, item = self.name('l'), self.name('x')
        self.put(f'if {count} > z - p: short()')
        self.put(f'{place} = {items} = []')
        self.put(f'for _ in range({count}):')
        self.depth += 1
        self.forget()
        if field.nested:
            from rosidl_embedded.definition import definition as find
            self.message(find(field.base), item)
        else:
            self.scalar(field, item)
        self.flush()
        self.put(f'{items}.append({item})')
        self.depth -= 1
        self.forget()


@lru_cache(maxsize=None)
def writer(definition_name: str) -> Callable[[Any, bytearray], None]:
    """Give the function that appends a message to a bytearray (a multiple of 8, plus 4, long)."""
    from rosidl_embedded.definition import definition as find
    generator = _Writer('def function(m, b):')
    generator.message(find(definition_name), 'm')
    generator.flush()
    return generator.finish(definition_name)


@lru_cache(maxsize=None)
def reader(definition_name: str) -> Callable[[Any, int], tuple[Any, int]]:
    """
    Give the function that reads a message from a buffer at a position.

    It raises :class:`TruncatedError` or ``struct.error`` where the buffer ends too early.
    """
    from rosidl_embedded.definition import definition as find
    from rosidl_embedded.message import CHECK_FIELDS, message_class
    generator = _Reader('def function(b, p):', message_class)
    generator.names['CHECK'] = CHECK_FIELDS
    generator.put('z = len(b)')
    generator.message(find(definition_name), 'm')
    generator.flush()
    generator.put('return m, p')
    return generator.finish(definition_name)


def serialize(message: Any, prefix: bytes = HEADER) -> bytearray:
    """
    Serialize a message.

    :param prefix: what precedes it: the encapsulation header, for a service also the request's.
    :raises AssertionError: in ROS 2's words, if a field holds what it mustn't.
    """
    buffer = bytearray(prefix)
    try:
        writer(message._definition.name)(message, buffer)
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
        return reader(name)(buffer, position)[0]
    except struct.error as error:
        raise TruncatedError(f'the serialized {name} is too short') from error
