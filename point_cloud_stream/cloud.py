# SPDX-License-Identifier: Apache-2.0
"""Describe point clouds as ``sensor_msgs/PointCloud2`` does, without ROS: layouts and checks."""

from __future__ import annotations

import dataclasses
import struct
from typing import Any

import numpy
from numpy.typing import NDArray

Octets = NDArray[numpy.uint8]
#: Bytes of the largest cloud that is coded: a million points of 32 bytes.
MAX_BYTES = 32 << 20
#: Bytes of the largest point.
MAX_POINT = 4096
#: Maximum number of fields, and of bytes of a field's name.
MOST_FIELDS = 255
#: Bytes of the datatypes of ``sensor_msgs/PointField``, INT8 = 1 to FLOAT64 = 8.
SIZES = (0, 1, 1, 2, 2, 4, 4, 4, 8)
FLOAT32 = 7
COORDINATES = ('x', 'y', 'z')
#: height, width, point_step, row_step, is_bigendian and is_dense, number of fields
_HEAD = struct.Struct('<IIIIBB')
#: offset, count, datatype, length of the name
_FIELD = struct.Struct('<IIBB')


class CloudError(ValueError):
    """A cloud cannot be encoded, or data cannot be decoded; one message for each cause."""


@dataclasses.dataclass(frozen=True)
class Field:
    """One field of each point; the values have the meaning of ``sensor_msgs/PointField``."""

    name: str
    offset: int
    datatype: int
    count: int = 1

    @property
    def size(self) -> int:
        """Bytes of the field in a point; some drivers write 0 for one value, as PCL allows."""
        return SIZES[self.datatype] * max(self.count, 1)


@dataclasses.dataclass(frozen=True)
class Layout:
    """The fields of ``sensor_msgs/PointCloud2`` except header and data."""

    height: int
    width: int
    fields: tuple[Field, ...]
    point_step: int
    row_step: int
    is_bigendian: bool = False
    is_dense: bool = False

    @property
    def points(self) -> int:
        """Number of points."""
        return self.height * self.width

    def check(self, max_bytes: int = MAX_BYTES) -> None:
        """
        Check sizes and fields before any memory is taken.

        :raises CloudError: the cloud has no x, y, z as float32, or the sizes contradict each
            other, or the data have more than ``max_bytes``.
        """
        # rows and columns take memory, even without points
        height, width = max(self.height, 1), max(self.width, 1)
        sizes = (self.row_step * height, 12 * height * width)
        if max(sizes) > max_bytes or self.point_step > MAX_POINT:
            raise CloudError('more points or bytes than allowed')
        if self.row_step < self.width * self.point_step:
            raise CloudError('row_step is less than a row')
        if max([len(self.fields), *(len(field.name.encode()) for field in self.fields)]) > (
                MOST_FIELDS):
            raise CloudError(f'more than {MOST_FIELDS} fields, or a name of more bytes')
        for field in self.fields:
            if not 0 < field.datatype < len(SIZES):
                raise CloudError('a field has an unknown datatype')
            if field.offset + field.size > self.point_step:
                raise CloudError('a field ends after the point')
        self.places()

    def places(self) -> list[int]:
        """
        Return the offsets of x, y and z; an empty cloud need not have these fields.

        :raises CloudError: one of the three is no single float32.
        """
        offsets = {field.name: field.offset for field in self.fields
                   if field.datatype == FLOAT32 and field.count < 2}
        if not offsets.keys() >= {*COORDINATES}:
            if not self.points:
                return []
            raise CloudError('x, y and z are not float32')
        return [offsets[name] for name in COORDINATES]

    def columns(self) -> list[tuple[int, int]]:
        """
        Return (offset, size) of all numbers of a point but x, y and z.

        Bytes that belong to no field are numbers of one byte. Of overlapping fields, the first
        one decides.
        """
        bytes_used = {at + i for at in self.places() for i in range(4)}
        columns: list[tuple[int, int]] = []
        for field in self.fields:
            size = SIZES[field.datatype]
            for at in range(field.offset, field.offset + field.size, size):
                if bytes_used.isdisjoint(range(at, at + size)):
                    bytes_used.update(range(at, at + size))
                    columns.append((at, size))
        return columns + [(at, 1) for at in range(self.point_step) if at not in bytes_used]

    def pack(self) -> bytes:
        """Return the layout as bytes."""
        out = [_HEAD.pack(self.height, self.width, self.point_step, self.row_step,
                          self.is_bigendian + 2 * self.is_dense, len(self.fields))]
        for field in self.fields:
            name = field.name.encode()
            out += [_FIELD.pack(field.offset, field.count, field.datatype, len(name)), name]
        return b''.join(out)


def unpack(data: bytes) -> tuple[Layout, int]:
    """
    Return the layout at the beginning of data, and its length.

    :raises struct.error: the data are too short.
    :raises UnicodeDecodeError: a name is not UTF-8.
    """
    height, width, point_step, row_step, flags, count = _HEAD.unpack_from(data)
    at = _HEAD.size
    fields = []
    for _ in range(count):
        offset, several, datatype, length = _FIELD.unpack_from(data, at)
        at += _FIELD.size + length
        fields.append(Field(data[at - length:at].decode(), offset, datatype, several))
    return Layout(height, width, tuple(fields), point_step, row_step, bool(flags & 1),
                  bool(flags & 2)), at


def rows(layout: Layout, data: Any) -> tuple[Octets, Octets]:
    """
    Return the points (points, point_step), which share the data where possible, and the padding.

    The padding is the bytes after each row's points (height, bytes).

    :raises CloudError: the data have another length than ``row_step * height``.
    """
    flat = numpy.frombuffer(data, numpy.uint8)
    if flat.size != layout.row_step * layout.height:
        raise CloudError('the data are not row_step * height bytes')
    lines, used = flat.reshape(layout.height, layout.row_step), layout.width * layout.point_step
    return lines[:, :used].reshape(layout.points, layout.point_step), lines[:, used:]
