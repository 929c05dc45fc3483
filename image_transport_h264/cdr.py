# SPDX-License-Identifier: Apache-2.0
"""
Read and write serialized messages, so that a node copies no large field into a Python message.

The form is CDR as ROS 2's middlewares use it (DDS-XTypes 1.3, 7.4.3, "plain CDR, version 1"):
four bytes, of which the second one is 1 for little-endian and 0 for big-endian numbers, then the
fields in order. A number begins at a multiple of its size, counted from the fifth byte.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

#: Bytes before the fields, and their value for little-endian numbers.
START, LITTLE = 4, b'\0\1\0\0'
#: Bytes of the longest string, far more than a frame id or an encoding has.
LONGEST = 1 << 14


class CdrError(ValueError):
    """A serialized message is malformed; the texts are few, so that a log can count them."""

    @property
    def cause(self) -> str:
        """The text, as key of a log's entries."""
        return str(self)


class Header(NamedTuple):
    """The fields of ``std_msgs/Header``."""

    sec: int
    nanosec: int
    frame_id: str


class Reader:
    """
    Read the fields of a message in order; each method raises CdrError where the data end too soon.

    :raises CdrError: the data begin with another form.
    """

    def __init__(self, data: bytes) -> None:
        self._data = memoryview(data)
        form = bytes(self._data[:2])
        if form not in (b'\0\0', b'\0\1') or len(data) < START:
            raise CdrError('a message in another form than CDR')
        self._order = '<' if form == b'\0\1' else '>'
        self._at = START

    def numbers(self, codes: str) -> tuple[int, ...]:
        """Return the next numbers; ``codes`` has their codes of the module ``struct``."""
        return tuple(self._number(code) for code in codes)

    def octets(self) -> memoryview:
        """Return the next sequence of bytes, which shares the message's memory."""
        length = self._number('I')
        return self._data[self._take(length):self._at]

    def string(self) -> str:
        """
        Return the next string; bytes that are no UTF-8 become U+FFFD, as in rclpy.

        :raises CdrError: the string is longer than LONGEST, or its final zero is missing.
        """
        length = self._number('I')
        if length > LONGEST:
            raise CdrError(f'a message with a string of more than {LONGEST} bytes')
        begin = self._take(length)
        text = bytes(self._data[begin:self._at])
        if text[-1:] not in (b'', b'\0'):
            raise CdrError('a message with a string that has no end')
        return text[:-1].decode(errors='replace')

    def header(self) -> Header:
        """Return the next ``std_msgs/Header``."""
        seconds, nanoseconds = self.numbers('iI')
        return Header(seconds, nanoseconds, self.string())

    def _number(self, code: str) -> Any:
        size = struct.calcsize(f'={code}')
        self._at += (START - self._at) % size
        return struct.unpack_from(self._order + code, self._data, self._take(size))[0]

    def _take(self, size: int) -> int:
        """Pass ``size`` bytes; return where they begin."""
        begin, self._at = self._at, self._at + size
        if self._at > len(self._data):
            raise CdrError('a message that ends too soon')
        return begin


class Writer:
    """Write the fields of a message in order, with little-endian numbers."""

    def __init__(self) -> None:
        self._parts: list[Any] = [LITTLE]
        self._size = 0

    def numbers(self, codes: str, *values: float) -> Writer:
        """Add numbers; ``codes`` has their codes of the module ``struct``."""
        for code, value in zip(codes, values):
            number = struct.pack(f'<{code}', value)
            self._put(bytes(-self._size % len(number)) + number)
        return self

    def octets(self, data: Any) -> Writer:
        """Add a sequence of bytes: a contiguous buffer, which :meth:`data` copies."""
        view = memoryview(data).cast('B')
        self.numbers('I', view.nbytes)
        self._put(view)
        return self

    def string(self, text: str) -> Writer:
        """Add a string."""
        return self.octets(text.encode() + b'\0')

    def header(self, header: Header) -> Writer:
        """Add a ``std_msgs/Header``."""
        return self.numbers('iI', header.sec, header.nanosec).string(header.frame_id)

    def data(self) -> bytes:
        """Return the message."""
        return b''.join(self._parts)

    def _put(self, part: Any) -> None:
        self._parts.append(part)
        self._size += len(part)
