# SPDX-License-Identifier: Apache-2.0
"""
Code point clouds: coordinates with a bounded error, everything else bit by bit.

An organised scan of a lidar is coded as a range image (see ``ranges``), with the steps by which
each coordinate differs from the prediction. Other clouds are coded as differences of quantised
coordinates, in the order of the points. Points whose coordinates are not finite, zero, or too
large for the resolution ("odd" points) are coded bit by bit. Each cloud can be decoded alone.

A coded cloud is MAGIC, the model, the quantisation step (float64, little-endian), the layout
(``cloud``), and columns (``numbers``): odd points, their coordinates, those of the others, then
all other numbers of a point, and the padding of rows.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Any

import numpy
from numpy.typing import NDArray

from point_cloud_stream import cloud, ranges
from point_cloud_stream.cloud import CloudError, COORDINATES, Layout, MAX_BYTES, Octets
from point_cloud_stream.numbers import Reader, Writer

#: The value of ``format`` of the message.
FORMAT = 'pointcloud'
MAGIC = b'PCS1'
#: Models: quantised coordinates, a range image, bit by bit.
GRID, LIDAR, LOSSLESS = range(3)
#: The quantisation step is a little less than the resolution, so that the rounding of float32
#: does not lead beyond half a resolution.
SLACK = 0.998
#: Largest coordinate in steps; four times as many must fit into 32 bits.
LARGEST = 2.0 ** 28
#: A cloud is coded as a range image if the prediction is wrong for at most this share of all
#: coordinates.
WRONG = 0.2
_HEAD = struct.Struct('<4sBd')


@dataclasses.dataclass(frozen=True)
class Coded:
    """
    A coded cloud.

    :param numbers: numbers that become shorter with a coarser resolution.
    """

    data: bytes
    resolution: float
    numbers: int


def encode(
    layout: Layout, data: Any, resolution: float, drop: frozenset[str] = frozenset(),
    max_bytes: int = MAX_BYTES,
) -> Coded:
    """
    Encode a cloud.

    :param resolution: twice the largest error of a coordinate in metres; 0 for none.
    :param drop: names of fields to leave out; their bytes become zero.
    :raises CloudError: the cloud contradicts itself, has no x, y, z as float32, or has more than
        ``max_bytes``.
    """
    layout.check(max_bytes)
    points, padding = cloud.rows(layout, data)
    dropped_fields = [each for each in layout.fields if each.name in drop - {*COORDINATES}]
    if dropped_fields:
        points = points.copy()
        for each in dropped_fields:
            points[:, each.offset:each.offset + each.size] = 0
        layout = dataclasses.replace(layout, fields=tuple(
            each for each in layout.fields if each not in dropped_fields))
    out = Writer()
    bits = [_strided(layout, points, at, 4).astype('<u4') for at in layout.places()]
    model, step = LOSSLESS, SLACK * resolution
    if resolution > 0 and bits:
        model = _write(out, layout, bits, step)
    else:
        for column in bits:
            out.shortest(column)
    for at, size in layout.columns():
        out.shortest(_strided(layout, points, at, size).astype(f'<u{size}'))
    if padding.size:
        out.shortest(padding.reshape(-1))
    head = _HEAD.pack(MAGIC, model, step) + layout.pack()
    return Coded(head + out.data(), resolution, layout.points * (3, 1, 0)[model])


def _write(out: Writer, layout: Layout, bits: list[NDArray[Any]], step: float) -> int:
    """Write x, y and z; return the model."""
    values = numpy.stack([column.view('<f4') for column in bits]).astype(numpy.float64)
    size = numpy.abs(values)
    # false for NaN, too
    plain = (size.max(0) < LARGEST * step) & (size[:2].max(0) > 0)
    out.shortest(numpy.packbits(plain))
    for column in bits:
        out.shortest(column[~plain])
    if min(layout.height, layout.width) > 1:
        scan = numpy.where(plain, values, 0.0).reshape(3, layout.height, layout.width)
        far = numpy.sqrt(scan[0] ** 2 + scan[1] ** 2)
        directions = ranges.fit(scan[0], scan[1], scan[2], far)
        steps = numpy.rint(far / step)
        off = [numpy.rint((exact - predicted) / step) for exact, predicted in zip(
            scan, ranges.predict(directions, steps * step))]
        if sum(map(numpy.count_nonzero, off)) <= WRONG * 3 * numpy.count_nonzero(plain):
            for table in directions:
                out.differences(table)
            for image in (steps, *off):
                out.differences(image.reshape(-1)[plain].astype('<i4'))
            return LIDAR
    for column in numpy.rint(values[:, plain] / step).astype('<i4'):
        out.differences(column)
    return GRID


def decode(data: bytes, max_bytes: int = MAX_BYTES) -> tuple[Layout, Octets]:
    """
    Decode a cloud to its layout and the data of ``sensor_msgs/PointCloud2``.

    :raises CloudError: the data are damaged, or the cloud has more than ``max_bytes``.
    """
    try:
        magic, model, step = _HEAD.unpack_from(data)
        layout, length = cloud.unpack(data[_HEAD.size:])
    except (struct.error, UnicodeDecodeError) as error:
        raise CloudError('a layout that was cut') from error
    if magic != MAGIC or model > LOSSLESS or not 0 <= step < 1e6:
        raise CloudError('no point cloud of ours')
    layout.check(max_bytes)
    columns = Reader(data, _HEAD.size + length)
    lines = numpy.zeros((layout.height, layout.row_step), numpy.uint8)
    points = numpy.zeros((layout.points, layout.point_step), numpy.uint8)
    places = layout.places()
    bits = [columns.numbers(layout.points, 4) for _ in places] if model == LOSSLESS else (
        _read(columns, model, layout, step))
    for at, column in zip(places, bits):
        _strided(layout, points, at, 4)[:] = column
    for at, size in layout.columns():
        _strided(layout, points, at, size)[:] = columns.numbers(layout.points, size)
    used = layout.width * layout.point_step
    lines[:, :used] = points.reshape(layout.height, used)
    padding = lines[:, used:]
    if padding.size:
        padding[:] = columns.numbers(padding.size, 1).reshape(padding.shape)
    return layout, lines.reshape(-1)


def _read(columns: Reader, model: int, layout: Layout, step: float) -> list[NDArray[Any]]:
    """Return the bits of x, y and z."""
    mask = columns.numbers((layout.points + 7) // 8, 1)
    plain = numpy.unpackbits(mask, count=layout.points).astype(bool)
    count = int(numpy.count_nonzero(plain))
    odd = [columns.numbers(layout.points - count, 4) for _ in COORDINATES]
    predicted: Any = numpy.zeros((3, layout.points))
    if model == LIDAR:
        directions = (columns.integers(layout.width), columns.integers(layout.height),
                      columns.integers(layout.height).view('<f4'))
        far = numpy.zeros((layout.height, layout.width))
        far.reshape(-1)[plain] = columns.integers(count) * step
        predicted = ranges.predict(directions, far)
    bits = []
    for axis, image in enumerate(predicted):
        column = numpy.empty(layout.points, '<u4')
        exact = image.reshape(-1)[plain] + columns.integers(count) * step
        with numpy.errstate(all='ignore'):  # hostile data
            column[plain], column[~plain] = exact.astype('<f4').view('<u4'), odd[axis]
        bits.append(column)
    return bits


def _strided(layout: Layout, points: Octets, at: int, size: int) -> NDArray[Any]:
    """Return one number of each point as an array that shares the points' memory."""
    number = f"{'>' if layout.is_bigendian else '<'}u{size}"
    kind = numpy.dtype({'names': ['number'], 'formats': [number], 'offsets': [at],
                        'itemsize': layout.point_step})
    column: NDArray[Any] = points.view(kind)['number'][:, 0]
    return column
