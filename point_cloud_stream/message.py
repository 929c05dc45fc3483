# SPDX-License-Identifier: Apache-2.0
"""Convert between serialized ``sensor_msgs/PointCloud2`` messages and clouds."""

from __future__ import annotations

from typing import Any

from image_transport_h264.cdr import Header, Reader, Writer
from point_cloud_stream.cloud import CloudError, Field, Layout, MOST_FIELDS


def cloud(data: bytes) -> tuple[Header, Layout, memoryview]:
    """
    Return header, layout and points of a message; the points share its memory.

    :raises CdrError: the message is malformed.
    :raises CloudError: the cloud has more than MOST_FIELDS fields.
    """
    reader = Reader(data)
    header = reader.header()
    height, width, count = reader.numbers('III')
    if count > MOST_FIELDS:
        raise CloudError(f'more than {MOST_FIELDS} fields')
    fields = []
    for _ in range(count):
        name = reader.string()
        offset, datatype, several = reader.numbers('IBI')
        fields.append(Field(name, offset, datatype, several))
    big, point_step, row_step = reader.numbers('BII')
    points = reader.octets()
    dense, = reader.numbers('B')
    return header, Layout(
        height, width, tuple(fields), point_step, row_step, bool(big), bool(dense)), points


def points(header: Header, layout: Layout, data: Any) -> bytes:
    """Return a cloud as a message, with one copy of its points."""
    writer = Writer().header(header).numbers(
        'III', layout.height, layout.width, len(layout.fields))
    for field in layout.fields:
        writer.string(field.name).numbers('IBI', field.offset, field.datatype, field.count)
    return writer.numbers(
        'BII', layout.is_bigendian, layout.point_step, layout.row_step).octets(data).numbers(
        'B', layout.is_dense).data()
