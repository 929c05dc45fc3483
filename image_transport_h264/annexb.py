# SPDX-License-Identifier: Apache-2.0
"""
Parse H.264 byte streams, and insert a SEI unit with the fields of a ROS image that H.264 lacks.

Annex B of ITU-T H.264 puts start codes between NAL units. A SEI message "user data unregistered"
(D.1.6, payload type 5) belongs to the owner of its UUID. Decoders skip unknown ones, so the
stream is an ordinary H.264 stream for every other decoder.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import re
import struct
from typing import Optional
import zlib

START_CODE = b'\x00\x00\x00\x01'
SLICE, IDR, SEI, SPS, PPS, DELIMITER = 1, 5, 6, 7, 8, 9
#: UUID of our user data, created once at random.
UUID = bytes.fromhex('5f0b6e0c8d3a4e6fb1c27a94d0e35812')
VERSION = 1

#: version, flags, stream, sequence, width, height, step, checksum, lengths of encoding and alpha
_HEADER = struct.Struct('>BBIIIIIIBI')
_KEY, _BIG_ENDIAN, _ALPHA_PLANE, _ALPHA_LEVEL = 1, 2, 4, 8


@dataclasses.dataclass(frozen=True)
class Tag:
    """
    Metadata of a packet, beside the coded picture.

    :param stream: random number of the encoder, to recognise a restarted encoder.
    :param sequence: number of the packet in the stream, from 0. A packet that is no keyframe
        needs the previous packet.
    :param key: whether decoding can start with this packet.
    :param checksum: CRC-32 of the packet without the tag.
    :param alpha_level: the opacity, if all pixels have the same one.
    :param alpha_plane: otherwise the opacities, row by row, compressed by zlib.
    """

    stream: int
    sequence: int
    key: bool
    width: int
    height: int
    encoding: str
    step: int
    is_bigendian: bool
    checksum: int = 0
    alpha_level: Optional[int] = None
    alpha_plane: bytes = b''

    def pack(self) -> bytes:
        """Serialise the tag."""
        flags = (self.key * _KEY | self.is_bigendian * _BIG_ENDIAN
                 | bool(self.alpha_plane) * _ALPHA_PLANE
                 | (self.alpha_level is not None) * _ALPHA_LEVEL)
        name = self.encoding.encode('ascii')
        alpha = self.alpha_plane
        if self.alpha_level is not None:
            alpha = bytes([self.alpha_level])
        body = _HEADER.pack(VERSION, flags, self.stream, self.sequence, self.width, self.height,
                            self.step, self.checksum, len(name), len(alpha)) + name + alpha
        return body + struct.pack('>I', zlib.crc32(body))

    @classmethod
    def unpack(cls, data: bytes) -> Optional[Tag]:
        """Parse a tag; return None if the bytes are no complete tag."""
        end = len(data) - 4
        if end < _HEADER.size or data[0] != VERSION:
            return None
        if zlib.crc32(data[:end]) != struct.unpack('>I', data[end:])[0]:
            return None
        (_, flags, stream, sequence, width, height, step, checksum, name_length,
         alpha_length) = _HEADER.unpack_from(data)
        if _HEADER.size + name_length + alpha_length != end:
            return None
        name = data[_HEADER.size:_HEADER.size + name_length]
        alpha = data[_HEADER.size + name_length:end]
        level = flags & _ALPHA_LEVEL
        return cls(
            stream=stream, sequence=sequence, key=bool(flags & _KEY), width=width, height=height,
            encoding=name.decode('ascii', 'replace'), step=step,
            is_bigendian=bool(flags & _BIG_ENDIAN), checksum=checksum,
            alpha_level=alpha[0] if level and alpha else None,
            alpha_plane=alpha if flags & _ALPHA_PLANE else b'')


def insert(tag: Tag, packet: bytes) -> bytes:
    """Return the packet with the tag at its start, or after an access unit delimiter."""
    sealed = dataclasses.replace(tag, checksum=zlib.crc32(packet))
    unit = START_CODE + _sei(UUID + sealed.pack())
    at = 0
    first = next(units(packet), None)
    if first is not None and packet[first[0]] & 31 == DELIMITER:
        at = first[1]
    return packet[:at] + unit + packet[at:]


def extract(packet: bytes) -> tuple[Optional[Tag], bytes]:
    """
    Return the packet's tag, and the packet without the tag.

    If there is no undamaged tag of ours, return None and the unchanged packet.
    """
    # Our tag is before the slices of the picture, so the search ends at the first slice.
    for begin, end in units(packet):
        kind = packet[begin] & 31
        if kind in (SLICE, IDR):
            break
        if kind != SEI:
            continue
        payload = _sei_payload(packet[begin:end])
        if payload is not None and payload[:16] == UUID:
            tag = Tag.unpack(payload[16:])
            if tag is None:
                break
            start = packet.rfind(b'\x00\x00\x01', 0, begin)
            while start > 0 and packet[start - 1] == 0:
                start -= 1
            return tag, packet[:start] + packet[end:]
    return None, packet


def units(packet: bytes) -> Iterator[tuple[int, int]]:
    """Yield the begin (after the start code) and the end of each NAL unit."""
    at = packet.find(b'\x00\x00\x01')
    while at >= 0:
        begin = at + 3
        at = packet.find(b'\x00\x00\x01', begin)
        end = len(packet) if at < 0 else at
        # Zeros before a start code belong to the start code.
        while end > begin and packet[end - 1] == 0:
            end -= 1
        if end > begin:
            yield begin, end


def kinds(packet: bytes) -> list[int]:
    """Return the types of the packet's NAL units."""
    return [packet[begin] & 31 for begin, _ in units(packet)]


def _sei(payload: bytes) -> bytes:
    """Return a SEI unit with one message of type 5, with emulation prevention."""
    size = len(payload)
    message = bytes([5]) + b'\xff' * (size // 255) + bytes([size % 255]) + payload
    return bytes([SEI]) + re.sub(
        b'\x00\x00(?=[\x00-\x03])', b'\x00\x00\x03', message + b'\x80')


def _sei_payload(unit: bytes) -> Optional[bytes]:
    """Return the payload of a SEI unit's first message if the message has type 5."""
    data = unit[1:].replace(b'\x00\x00\x03', b'\x00\x00')
    if not data or data[0] != 5:
        return None
    size, at = 0, 1
    while at < len(data) and data[at] == 255:
        size += 255
        at += 1
    if at >= len(data):
        return None
    size += data[at]
    payload = data[at + 1:at + 1 + size]
    return payload if len(payload) == size else None
