# SPDX-License-Identifier: Apache-2.0
"""Convert between ROS messages, pictures and packets."""

from __future__ import annotations

import array
import importlib
import struct
from typing import Any, Optional

from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from image_transport_h264.codec import Packet, Picture

#: Last part of the names of a stream's auxiliary topics.
KEY_REQUEST, FEEDBACK, PIECES, CAMERA_INFO = 'keyframe', 'feedback', 'pieces', 'camera_info'

#: seconds, nanoseconds, length of the frame id
_HEADER = struct.Struct('>iIH')


def picture(message: Image) -> Picture:
    """Return the picture of a message; it shares the message's data."""
    return Picture(message.width, message.height, message.encoding, message.step,
                   memoryview(message.data), bool(message.is_bigendian))


def image(header: Header, shown: Picture) -> Image:
    """Return a picture as a message, with one copy of the data."""
    return Image(
        header=header, height=shown.height, width=shown.width, encoding=shown.encoding,
        is_bigendian=int(shown.is_bigendian), step=shown.step, data=octets(shown.data))


def octets(data: Any) -> 'array.array[int]':
    """Convert bytes to an array, which rclpy takes over without a check of each byte."""
    if isinstance(data, array.array):
        return data
    values = array.array('B')
    values.frombytes(data)
    return values


def compressed(header: Header, packet: Packet) -> CompressedImage:
    """
    Return a packet as a message.

    ``format`` is only 'h264', which viewers know; the packet contains the original encoding.
    """
    return CompressedImage(header=header, format=packet.format, data=octets(packet.data))


def with_header(header: Header, data: bytes) -> bytes:
    """Return a packet with its message's header in front, to be sent in pieces."""
    name: bytes = header.frame_id.encode()
    return _HEADER.pack(header.stamp.sec, header.stamp.nanosec, len(name)) + name + data


def header_and_data(whole: bytes) -> tuple[Header, bytes]:
    """Split the bytes of :func:`with_header` into header and packet."""
    seconds, nanoseconds, length = _HEADER.unpack_from(whole)
    header = Header(frame_id=whole[_HEADER.size:_HEADER.size + length].decode(errors='replace'))
    header.stamp.sec, header.stamp.nanosec = seconds, nanoseconds
    return header, whole[_HEADER.size + length:]


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
    return kind(
        header=header, width=tag.width, height=tag.height,
        encoding=f'h264;yuv420p;bgr8;{tag.encoding}', pts=tag.sequence, flags=int(tag.key),
        is_bigendian=tag.is_bigendian, data=octets(packet.data))


def compressed_video(kind: Any, header: Header, packet: Packet) -> Any:
    """Return a packet as ``foxglove_msgs/CompressedVideo``."""
    return kind(timestamp=header.stamp, frame_id=header.frame_id, format='h264',
                data=octets(packet.data))
