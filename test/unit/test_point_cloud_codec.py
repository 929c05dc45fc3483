# SPDX-License-Identifier: Apache-2.0
"""The codec of point clouds by value: round trips, bounds of the error, hostile data."""

from __future__ import annotations

import dataclasses
import struct
from typing import Any

import numpy
import pytest

pytest.importorskip('zstandard', reason='the extra "point-clouds" is not installed')
import zstandard

from fogros2_examples.city import City
from point_cloud_stream import codec, numbers
from point_cloud_stream.cloud import CloudError, Field, Layout, unpack
from point_cloud_stream.codec import Coded, decode, encode

KINDS = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}
SCAN = City(16, 256).scan(3)


def layout(scan: Any, **changes: Any) -> Layout:
    """Return the layout of a structured array (rows, columns)."""
    fields = []
    for name in scan.dtype.names:
        kind, offset = scan.dtype.fields[name][:2]
        count = int(numpy.prod(kind.shape, dtype=int))
        fields.append(Field(name, offset, KINDS[kind.base.str[1:]], count))
    rows, columns = scan.shape
    step = scan.dtype.itemsize
    return dataclasses.replace(
        Layout(rows, columns, tuple(fields), step, step * columns), **changes)


def scan_of(coordinates: Any, rows: int = 1) -> Any:
    """Return a cloud (rows, columns) with x, y and z alone."""
    points = numpy.asarray(coordinates, '<f4')
    return points.view([('x', '<f4'), ('y', '<f4'), ('z', '<f4')]).reshape(rows, -1)


def returned(scan: Any, resolution: float) -> tuple[Any, Coded]:
    """Return a cloud after its way through the codec, and what was coded."""
    coded = encode(layout(scan), scan.tobytes(), resolution)
    there, data = decode(coded.data)
    assert there == layout(scan)
    return data.view(scan.dtype).reshape(scan.shape), coded


def model(coded: Coded) -> int:
    return coded.data[4]


def largest_error(before: Any, after: Any) -> float:
    """Return the largest error of a coordinate; NaN has to be where it was."""
    errors = []
    for name in 'xyz':
        assert (numpy.isnan(before[name]) == numpy.isnan(after[name])).all()
        errors.append(numpy.nanmax(abs(before[name].astype(float) - after[name])))
    return float(max(errors))


@pytest.mark.parametrize('resolution', [0.001, 0.01, 0.1])
@pytest.mark.parametrize('rows', [16, 1])
def test_scan_keeps_order_fields_and_bound(resolution: float, rows: int) -> None:
    scan = SCAN.reshape(rows, -1)
    after, coded = returned(scan, resolution)
    assert model(coded) == (codec.LIDAR if rows > 1 else codec.GRID)
    assert largest_error(scan, after) <= resolution / 2
    for name in ('intensity', 'ring', 'time'):
        assert (scan[name] == after[name]).all()


def test_range_image_takes_fewer_bytes_than_the_grid() -> None:
    sizes = [len(returned(SCAN.reshape(rows, -1), 0.01)[1].data) for rows in (16, 1)]
    assert sizes[0] < 0.75 * sizes[1]


def test_lossless_returns_identical_bytes() -> None:
    after, coded = returned(SCAN, 0.0)
    assert after.tobytes() == SCAN.tobytes() and model(coded) == codec.LOSSLESS
    assert coded.numbers == 0


def test_points_without_a_pattern_keep_the_bound() -> None:
    """A cloud of rows and columns whose directions are no product falls back to the grid."""
    scan = scan_of(numpy.random.default_rng(1).uniform(-50, 50, (40, 30, 3)), 40)
    after, coded = returned(scan, 0.02)
    assert model(coded) == codec.GRID and coded.numbers == 3 * 1200
    assert largest_error(scan, after) <= 0.01


@pytest.mark.parametrize('rows', [1, 2])
def test_odd_points_are_kept_bit_by_bit(rows: int) -> None:
    inf, nan = numpy.inf, numpy.nan
    odd = [(0, 0, 0), (-0.0, 0, 5), (nan, 1, 2), (1, nan, 2), (1, 2, nan), (inf, 0, 0),
           (0, -inf, 0), (1e30, 0, 0), (3e38, -3e38, 1e-45)]
    scan = scan_of([*odd, (1, 2, 3)], rows)
    # NaN with a payload
    scan.view('<u4').reshape(-1)[6] = 0x7fc12345
    after, _ = returned(scan, 0.01)
    assert after.tobytes()[:12 * len(odd)] == scan.tobytes()[:12 * len(odd)]
    assert largest_error(scan.reshape(1, -1)[:, -1:], after.reshape(1, -1)[:, -1:]) <= 0.005


@pytest.mark.parametrize('shape', [(0, 0), (1, 0), (0, 5), (1, 1), (1, 3), (3, 1), (2, 2)])
@pytest.mark.parametrize('resolution', [0.0, 0.01])
def test_small_and_empty_clouds(shape: tuple[int, int], resolution: float) -> None:
    scan = SCAN[:shape[0], :shape[1]].copy()
    after, _ = returned(scan, resolution)
    assert scan.shape == after.shape
    if scan.size:
        assert (scan['ring'] == after['ring']).all()


@pytest.mark.parametrize('kind', [
    [('z', 'f4'), ('rgb', 'f4'), ('y', 'f4'), ('x', 'f4')],
    [('x', 'f4'), ('y', 'f4'), ('z', 'f4'), ('histogram', 'f4', 5), ('stamp', 'f8')],
    [('a', 'i1'), ('x', 'f4'), ('b', 'u1'), ('y', 'f4'), ('c', 'i2'), ('z', 'f4'), ('d', 'i4'),
     ('e', 'u4')],
    {'names': ['x', 'y', 'z', 'i'], 'formats': ['f4', 'f4', 'f4', 'u2'],
     'offsets': [4, 8, 16, 24], 'itemsize': 32}])
@pytest.mark.parametrize('big', [False, True])
def test_any_layout_keeps_its_other_bytes(kind: Any, big: bool) -> None:
    """Padding and unaligned fields included."""
    dtype = numpy.dtype(kind).newbyteorder('>' if big else '<')
    octets = numpy.random.default_rng(2).integers(0, 256, 90 * dtype.itemsize, numpy.uint8)
    scan = octets.view(dtype).reshape(9, 10)
    for name in 'xyz':
        scan[name] = numpy.random.default_rng(3).normal(0, 9, scan.shape)
    what = layout(scan, is_bigendian=big, is_dense=True)
    there, data = decode(encode(what, scan.tobytes(), 0.01).data)
    after = data.view(dtype).reshape(scan.shape)
    assert there == what and largest_error(scan, after) <= 0.005
    for name in 'xyz':
        after[name] = scan[name]
    assert after.tobytes() == scan.tobytes()


def test_rows_may_have_padding() -> None:
    what = layout(SCAN, row_step=SCAN.strides[0] + 7)
    padded = numpy.pad(SCAN.view(numpy.uint8).reshape(16, -1), ((0, 0), (0, 7)),
                       constant_values=9)
    there, data = decode(encode(what, padded.tobytes(), 0.0).data)
    assert there == what and data.tobytes() == padded.tobytes()


@pytest.mark.parametrize('resolution', [0.0, 0.01])
def test_empty_cloud_needs_no_fields(resolution: float) -> None:
    """Nodes publish a default message when they have found nothing."""
    for what in Layout(0, 0, (), 0, 0), Layout(1, 0, (), 16, 0), Layout(3, 0, (), 4, 5):
        data = bytes(what.height * what.row_step)
        there, after = decode(encode(what, data, resolution).data)
        assert there == what and after.tobytes() == data


@pytest.mark.parametrize('resolution', [0.0, 0.01])
def test_count_of_zero_is_one_value(resolution: float) -> None:
    """PCL takes it so, because some drivers do not fill in the count."""
    what = layout(SCAN)
    what = dataclasses.replace(what, fields=tuple(
        dataclasses.replace(field, count=0) for field in what.fields))
    there, data = decode(encode(what, SCAN.tobytes(), resolution).data)
    after = data.view(SCAN.dtype).reshape(SCAN.shape)
    assert there == what and (after['time'] == SCAN['time']).all()
    assert largest_error(SCAN, after) <= resolution / 2


def test_dropped_fields_take_nothing_and_become_zero() -> None:
    whole = encode(layout(SCAN), SCAN.tobytes(), 0.01)
    coded = encode(layout(SCAN), SCAN.tobytes(), 0.01, frozenset({'intensity', 'x', 'none'}))
    there, data = decode(coded.data)
    assert [field.name for field in there.fields] == ['x', 'y', 'z', 'ring', 'time']
    after = data.view(SCAN.dtype).reshape(SCAN.shape)
    assert not after['intensity'].any() and (after['ring'] == SCAN['ring']).all()
    assert len(coded.data) < 0.75 * len(whole.data)


@pytest.mark.parametrize('column', [
    [0, 255, 1, 254], [0.0, 1.0, 255.0, 7.0], [-1.0, 0.5, numpy.nan, -0.0],
    [2.0 ** 31, 2.0 ** 40]])
@pytest.mark.parametrize('kind', ['u1', 'u2', 'u4', 'u8', 'f4', 'f8'])
def test_columns_are_returned_bit_by_bit(column: list[float], kind: str) -> None:
    with numpy.errstate(invalid='ignore', over='ignore'):
        values = numpy.array(column).astype(f'<{kind}')
    bits = values.view(f'<u{values.dtype.itemsize}')
    writer = numbers.Writer()
    writer.shortest(bits)
    writer.differences(bits)
    reader = numbers.Reader(writer.data(), 0)
    for _ in range(2):
        assert (reader.numbers(len(bits), bits.dtype.itemsize) == bits).all()


@pytest.mark.parametrize('changes, why', [
    ({'fields': ()}, 'not float32'), ({'row_step': 5}, 'row_step'),
    ({'width': 257}, 'row_step'), ({'height': 2 ** 31}, 'more points'),
    ({'height': 17}, 'row_step \\* height'), ({'point_step': 2 ** 20}, 'more points'),
    ({'fields': 256 * (Field('a', 0, 7), )}, '255'),
    ({'fields': (Field('é' * 128, 0, 7), )}, '255'),
    ({'fields': (Field('x', 20, 7), )}, 'after the point'),
    ({'fields': (Field('x', 0, 9), )}, 'datatype'),
    ({'fields': (Field('x', 0, 7, 2 ** 31), )}, 'after the point')])
def test_clouds_that_contradict_themselves_are_refused(
    changes: dict[str, Any], why: str,
) -> None:
    with pytest.raises(CloudError, match=why):
        encode(layout(SCAN, **changes), SCAN.tobytes(), 0.01)


def test_a_column_that_claims_more_is_not_unpacked() -> None:
    """The frame's own size decides how much memory the library takes."""
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 28))
    column = struct.pack('<IB', len(bomb), 1 << 4) + bomb
    with pytest.raises(CloudError, match='another size'):
        numbers.Reader(column, 0).numbers(1000, 4)


def test_larger_clouds_than_allowed_are_refused() -> None:
    coded = encode(layout(SCAN), SCAN.tobytes(), 0.01)
    with pytest.raises(CloudError, match='more points'):
        decode(coded.data, max_bytes=SCAN.nbytes - 1)
    assert decode(coded.data, max_bytes=SCAN.nbytes)[0] == layout(SCAN)
    with pytest.raises(CloudError, match='more points'):
        encode(layout(SCAN), SCAN.tobytes(), 0.01, max_bytes=SCAN.nbytes - 1)


def test_layouts_are_read_as_they_were_written() -> None:
    what = layout(SCAN, is_dense=True)
    assert unpack(what.pack() + b'more') == (what, len(what.pack()))
