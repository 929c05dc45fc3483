# SPDX-License-Identifier: Apache-2.0
"""Convert between serialized ROS messages, pictures and packets."""

from __future__ import annotations

import array
import importlib
import struct
from typing import Any, Optional, TYPE_CHECKING

from image_transport_h264.cdr import CdrError, Header, Reader, Writer
from image_transport_h264.picture import Buffer, Picture

if TYPE_CHECKING:
    from image_transport_h264.codec import Packet

#: Last part of the names of a stream's auxiliary topics.
KEY_REQUEST, FEEDBACK, PIECES = 'keyframe', 'feedback', 'pieces'
SLICES, ACKNOWLEDGED, CAMERA_INFO = 'slices', 'acknowledged', 'camera_info'

#: seconds, nanoseconds, length of the frame id
_HEADER = struct.Struct('>iIH')


def picture(data: bytes) -> tuple[Header, Picture]:
    """
    Read a serialized ``sensor_msgs/Image``; the picture shares the message's memory.

    :raises CdrError: the message is malformed.
    """
    reader = Reader(data)
    header = reader.header()
    height, width = reader.numbers('II')
    encoding = reader.string()
    big, step = reader.numbers('BI')
    return header, Picture(width, height, encoding, step, reader.octets(), bool(big))


def image(header: Header, shown: Picture) -> bytes:
    """Return a picture as a serialized ``sensor_msgs/Image``, with one copy of the data."""
    return Writer().header(header).numbers('II', shown.height, shown.width).string(
        shown.encoding).numbers('BI', shown.is_bigendian, shown.step).octets(shown.data).data()


def coded(data: bytes) -> tuple[Header, str, memoryview]:
    """
    Return header, format and data of a serialized ``sensor_msgs/CompressedImage``.

    :raises CdrError: the message is malformed.
    """
    reader = Reader(data)
    return reader.header(), reader.string(), reader.octets()


def compressed(header: Header, form: str, data: Buffer) -> bytes:
    """
    Return a packet as a serialized ``sensor_msgs/CompressedImage``.

    :param form: of H.264 only 'h264', which viewers know; the packet has the original encoding.
    """
    return Writer().header(header).string(form).octets(data).data()


def piece(data: bytes) -> bytes:
    """
    Return the data of a serialized ``std_msgs/UInt8MultiArray`` without dimensions.

    :raises CdrError: the message is malformed.
    """
    reader = Reader(data)
    dimensions, _ = reader.numbers('II')
    if dimensions:
        raise CdrError('a piece of a packet with dimensions')
    return bytes(reader.octets())


def in_pieces(data: bytes) -> bytes:
    """Return a piece of a packet as a serialized ``std_msgs/UInt8MultiArray``."""
    return Writer().numbers('II', 0, 0).octets(data).data()


def octets(data: Buffer) -> 'array.array[int]':
    """Convert bytes to an array, which rclpy takes over without a check of each byte."""
    return array.array('B', bytes(data))


def with_header(header: Header, data: bytes) -> bytes:
    """Return a packet with its message's header in front, to be sent in pieces."""
    name = header.frame_id.encode()
    return _HEADER.pack(header.sec, header.nanosec, len(name)) + name + data


def header_and_data(whole: bytes) -> tuple[Header, bytes]:
    """
    Split the bytes of :func:`with_header` into header and packet.

    :raises CdrError: the bytes are too few.
    """
    if len(whole) < _HEADER.size:
        raise CdrError('a packet in pieces without a header')
    seconds, nanoseconds, length = _HEADER.unpack_from(whole)
    begin = _HEADER.size + length
    name = whole[_HEADER.size:begin].decode(errors='replace')
    return Header(seconds, nanoseconds, name), whole[begin:]


def camera_info_topic(topic: str) -> str:
    """Return the topic of the CameraInfo messages that belong to an image topic."""
    return topic.rpartition('/')[0] + '/' + CAMERA_INFO


def installed(package: str, name: str) -> Optional[Any]:
    """Return a message class of an optional package, None if it is not installed."""
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name, None)
    except ModuleNotFoundError:
        return None


def ffmpeg_packet(kind: Any, header: Header, packet: Packet) -> Any:
    """Return a packet as ``ffmpeg_image_transport_msgs/FFMPEGPacket``."""
    tag = packet.tag
    made = kind(
        width=tag.width, height=tag.height, encoding=f'h264;yuv420p;bgr8;{tag.encoding}',
        pts=tag.sequence, flags=int(tag.key), is_bigendian=tag.is_bigendian,
        data=octets(packet.data))
    made.header.stamp.sec, made.header.stamp.nanosec, made.header.frame_id = header
    return made
