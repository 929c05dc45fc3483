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
SLICE, PARTITION, IDR, SEI, SPS, PPS, DELIMITER = 1, 2, 5, 6, 7, 8, 9
#: UUID of our user data, created once at random.
UUID = bytes.fromhex('5f0b6e0c8d3a4e6fb1c27a94d0e35812')
VERSION = 1
#: Bytes of the longest sequence parameter set that is parsed, up to its sizes.
LONGEST_SPS = 4096
#: Profiles whose sequence parameter sets state chroma format and bit depth.
_HIGH = (44, 83, 86, 100, 110, 118, 122, 128, 138, 144, 244)

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


def parameter_sets(packet: bytes) -> Iterator[Sps]:
    """
    Yield the sizes in the packet's sequence parameter sets.

    FFmpeg reads a set that makes no sense once more with its emulation prevention bytes, so such a
    set has two meanings.

    :raises ValueError: a set is cut or invalid.
    """
    for begin, end in units(packet):
        if packet[begin] & 31 == SPS:
            unit = packet[begin:end]
            for body in {unit, unit.replace(b'\x00\x00\x03', b'\x00\x00')}:
                yield Sps.parse(body)


def pictures(packet: bytes) -> int:
    """Return the number of fields or frames: slices that begin with the first macroblock."""
    return sum(packet[begin] & 31 in (SLICE, PARTITION, IDR) and packet[begin + 1:end] >= b'\x80'
               for begin, end in units(packet))


def kinds(packet: bytes) -> list[int]:
    """Return the types of the packet's NAL units."""
    return [packet[begin] & 31 for begin, _ in units(packet)]


@dataclasses.dataclass(frozen=True)
class Sps:
    """
    Sizes in a sequence parameter set (7.3.2.1.1).

    :param references: frames that the decoder keeps beside the current one.
    :param sample_bytes: bytes per pixel of all planes.
    """

    width: int
    height: int
    references: int
    sample_bytes: float

    @classmethod
    def parse(cls, unit: bytes) -> Sps:
        """
        Parse a NAL unit without emulation prevention.

        :raises ValueError: the unit is cut or invalid.
        """
        bits = _Bits(unit[1:LONGEST_SPS])
        profile, _, _ = bits.fixed(8), bits.fixed(16), bits.golomb()
        chroma, deep = 1, False
        if profile in _HIGH:
            chroma = bits.golomb()
            bits.fixed(chroma == 3)
            deep = bits.golomb() + bits.golomb() > 0
            bits.fixed(1)
            if bits.fixed(1):
                for index in range(12 if chroma == 3 else 8):
                    if bits.fixed(1):
                        bits.skip_scaling_list(16 if index < 6 else 64)
        bits.golomb()
        order = bits.golomb()
        if order == 0:
            bits.golomb()
        elif order == 1:
            bits.fixed(1), bits.golomb(), bits.golomb()
            for _ in range(bits.golomb()):
                bits.golomb()
        references = bits.golomb()
        bits.fixed(1)
        width, height = 16 * (bits.golomb() + 1), 16 * (bits.golomb() + 1)
        return cls(width, height * (2 - bits.fixed(1)), references,
                   {2: 2.0, 3: 3.0}.get(chroma, 1.5) * (1 + deep))


class _Bits:
    """Read the bits of a parameter set; a ValueError ends a cut one."""

    def __init__(self, data: bytes) -> None:
        self._bits, self._at = ''.join(f'{byte:08b}' for byte in data), 0

    def fixed(self, count: int) -> int:
        """Read u(count)."""
        self._at += count
        if self._at > len(self._bits):
            raise ValueError('a parameter set that was cut')
        return int('0' + self._bits[self._at - count:self._at], 2)

    def golomb(self) -> int:
        """Read ue(v), or se(v) as the number of its code."""
        zeros = self._bits.index('1', self._at) - self._at
        if zeros > 32:
            raise ValueError('a number that is too large')
        return self.fixed(2 * zeros + 1) - 1

    def skip_scaling_list(self, size: int) -> None:
        """Read scaling_list() (7.3.2.1.1.1)."""
        scale = 8
        for _ in range(size):
            code = self.golomb()
            scale = (scale + (-(code // 2) if code % 2 == 0 else (code + 1) // 2)) % 256
            if scale == 0:
                return


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
