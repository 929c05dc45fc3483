# SPDX-License-Identifier: Apache-2.0
"""
Readers and writers of serialized messages, against rclpy and with damaged data.

``test_fuzzed_inputs.py`` has hostile ones.
"""

from __future__ import annotations

import array
from collections.abc import Callable
import struct
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy
import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header as HeaderMessage
from std_msgs.msg import UInt8MultiArray

from fogros2_replicas.pairs import header_of
from image_transport_h264 import message
from image_transport_h264.cdr import CdrError, Header, LONGEST, Reader, Writer
from image_transport_h264.picture import Picture
from point_cloud_stream import message as clouds
from point_cloud_stream.cloud import CloudError, Field, Layout

HEADER = Header(-3, 999_999_999, 'camera')
FORMS = {'<': b'\0\1\0\0', '>': b'\0\0\0\0'}


def written(order: str, *fields: Any) -> bytes:
    """Serialize in another way than the code under test: pairs (code, value), text or bytes."""
    out = b''
    for field in fields:
        if isinstance(field, tuple):
            code, value = field
            size = struct.calcsize('=' + code)
            out += bytes((size - len(out) % size) % size) + struct.pack(order + code, value)
        else:
            data = field if isinstance(field, bytes) else field.encode() + b'\0'
            out += bytes((4 - len(out) % 4) % 4) + struct.pack(order + 'I', len(data)) + data
    return FORMS[order] + out


def header_fields(header: Header) -> list[Any]:
    return [('i', header.sec), ('I', header.nanosec), header.frame_id]


def image_fields(header: Header, one: Picture) -> list[Any]:
    return [*header_fields(header), ('I', one.height), ('I', one.width), one.encoding,
            ('B', one.is_bigendian), ('I', one.step), bytes(one.data)]


def coded_fields(header: Header, form: str, data: bytes) -> list[Any]:
    return [*header_fields(header), form, data]


def cloud_fields(header: Header, layout: Layout, data: bytes) -> list[Any]:
    fields: list[Any] = []
    for one in layout.fields:
        fields += [one.name, ('I', one.offset), ('B', one.datatype), ('I', one.count)]
    return [*header_fields(header), ('I', layout.height), ('I', layout.width),
            ('I', len(layout.fields)), *fields, ('B', layout.is_bigendian),
            ('I', layout.point_step), ('I', layout.row_step), data, ('B', layout.is_dense)]


numbers = st.integers(0, 2 ** 32 - 1)
texts = st.text(st.characters(exclude_characters='\0', exclude_categories=['Cs']), max_size=9)
headers = st.builds(Header, st.integers(-2 ** 31, 2 ** 31 - 1), numbers, texts)
octets = st.binary(max_size=40)
pictures = st.builds(Picture, numbers, numbers, texts, numbers, octets, st.booleans())
layouts = st.builds(
    Layout, numbers, numbers,
    st.lists(st.builds(Field, texts, numbers, st.integers(0, 255), numbers),
             max_size=4).map(tuple),
    numbers, numbers, st.booleans(), st.booleans())


def test_number_of_eight_bytes_counts_from_the_fifth() -> None:
    data = Writer().numbers('BQ', 7, 8).data()
    assert data == bytes.fromhex('00010000' '07' '00000000000000' '0800000000000000')
    assert Reader(data).numbers('BQ') == (7, 8)


def ros(header: Header) -> HeaderMessage:
    made = HeaderMessage(frame_id=header.frame_id)
    made.stamp.sec, made.stamp.nanosec = header.sec, header.nanosec
    return made


def ros_cloud(header: Header, layout: Layout, data: bytes) -> PointCloud2:
    return PointCloud2(
        header=ros(header), height=layout.height, width=layout.width, fields=[
            PointField(name=one.name, offset=one.offset, datatype=one.datatype, count=one.count)
            for one in layout.fields],
        is_bigendian=layout.is_bigendian, point_step=layout.point_step,
        row_step=layout.row_step, is_dense=layout.is_dense, data=array.array('B', data))


@settings(deadline=None)
@given(header=headers, one=pictures)
def test_image_is_what_rclpy_makes_and_reads(header: Header, one: Picture) -> None:
    made = Image(header=ros(header), height=one.height, width=one.width, encoding=one.encoding,
                 is_bigendian=int(one.is_bigendian), step=one.step,
                 data=array.array('B', bytes(one.data)))
    big = written('>', *image_fields(header, one))
    assert message.picture(serialize_message(made)) == message.picture(big) == (header, one)
    for data in (message.image(header, one), big):
        assert deserialize_message(data, Image) == made


@settings(deadline=None)
@given(header=headers, form=texts, data=octets)
def test_packet_is_what_rclpy_makes_and_reads(header: Header, form: str, data: bytes) -> None:
    made = CompressedImage(header=ros(header), format=form, data=array.array('B', data))
    big = written('>', *coded_fields(header, form, data))
    assert message.coded(serialize_message(made)) == message.coded(big) == (header, form, data)
    assert deserialize_message(message.compressed(header, form, data), CompressedImage) == made
    assert header_of(big) == (header.sec * 10 ** 9 + header.nanosec, header.frame_id)


@settings(deadline=None)
@given(data=octets)
def test_piece_is_what_rclpy_makes_and_reads(data: bytes) -> None:
    made = UInt8MultiArray(data=array.array('B', data))
    big = written('>', ('I', 0), ('I', 0), data)
    assert message.piece(serialize_message(made)) == message.piece(big) == data
    assert deserialize_message(message.in_pieces(data), UInt8MultiArray) == made


@settings(deadline=None)
@given(header=headers, layout=layouts, data=octets)
def test_cloud_is_what_rclpy_makes_and_reads(
    header: Header, layout: Layout, data: bytes,
) -> None:
    made = ros_cloud(header, layout, data)
    big = written('>', *cloud_fields(header, layout, data))
    assert clouds.cloud(serialize_message(made)) == clouds.cloud(big) == (header, layout, data)
    for written_so in (clouds.points(header, layout, data), big):
        assert deserialize_message(written_so, PointCloud2) == made


READERS: list[tuple[Callable[[bytes], Any], list[Any]]] = [
    (message.picture, image_fields(HEADER, Picture(2, 1, 'mono8', 3, b'abc'))),
    (message.coded, coded_fields(HEADER, 'h264', b'abc')),
    (message.piece, [('I', 0), ('I', 0), b'abc']),
    (clouds.cloud, cloud_fields(HEADER, Layout(1, 2, (Field('x', 0, 7),), 4, 8), b'abc')),
]
READER_NAMES = ['image', 'packet', 'piece', 'cloud']


@pytest.mark.parametrize('order', FORMS)
@pytest.mark.parametrize(('read', 'fields'), READERS, ids=READER_NAMES)
def test_message_that_ends_anywhere_too_soon_is_refused(
    read: Callable[[bytes], Any], fields: list[Any], order: str,
) -> None:
    data = written(order, *fields)
    read(data)
    read(data + b'\0\0\0')  # middlewares pad
    for end in range(len(data)):
        with pytest.raises(CdrError):
            read(data[:end])


@pytest.mark.parametrize('form', ['0002', '0100'])
def test_other_form_than_plain_cdr_is_refused(form: str) -> None:
    data = written('<', *image_fields(HEADER, Picture(2, 1, 'mono8', 3, b'abc')))
    with pytest.raises(CdrError, match='form'):
        message.picture(bytes.fromhex(form) + data[2:])


def test_options_of_the_form_are_ignored() -> None:
    """Cyclone DDS writes there how many bytes it padded."""
    data = written('<', *coded_fields(HEADER, 'h264', b'abc'))
    assert message.coded(data[:2] + b'\0\3' + data[4:] + b'\0\0\0')[0] == HEADER


def test_strings_are_checked() -> None:
    assert Reader(written('<', 'a' * (LONGEST - 1))).string() == 'a' * (LONGEST - 1)
    with pytest.raises(CdrError, match='string of more'):
        Reader(written('<', 'a' * LONGEST)).string()
    with pytest.raises(CdrError, match='no end'):
        Reader(written('<', b'abc')).string()
    assert Reader(written('<', b'')).string() == ''
    assert Reader(written('<', b'a\xff\0')).string() == 'a\ufffd'


def test_header_of_any_message_fits_into_pieces() -> None:
    """The longest frame id grows threefold where it is no UTF-8."""
    header = Reader(written('<', ('i', 1), ('I', 2), b'\xff' * (LONGEST - 1) + b'\0')).header()
    whole = message.with_header(header, b'packet')
    assert message.header_and_data(whole) == (header, b'packet')
    with pytest.raises(CdrError):
        message.header_and_data(whole[:9])


def test_cloud_with_many_fields_is_refused_at_once() -> None:
    layout = Layout(1, 1, (Field('x', 0, 7),) * 256, 4, 4)
    with pytest.raises(CloudError, match='255 fields'):
        clouds.cloud(written('<', *cloud_fields(HEADER, layout, b'')))


def test_data_are_read_without_a_copy() -> None:
    data = written('<', *image_fields(HEADER, Picture(2, 1, 'mono8', 3, b'abc')))
    _, shown = message.picture(data)
    assert numpy.shares_memory(numpy.frombuffer(shown.data, numpy.uint8),
                               numpy.frombuffer(data, numpy.uint8))
