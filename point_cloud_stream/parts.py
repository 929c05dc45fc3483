# SPDX-License-Identifier: Apache-2.0
"""
Split coded clouds into parts, each of which is one message, and put them together again.

With one message for a cloud, the packets of a video would wait behind all of its fragments. So the
encoder sends a few parts, and the next one when a part has arrived.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Optional
import zlib

#: Last part of the name of the topic of acknowledgements.
FEEDBACK = 'feedback'
#: Bytes of a part: 6.6 ms of a link of 10 Mbit/s; more for large clouds, of which MANY parts
#: together fill a long link.
LEAST, LARGEST, MANY = 8192, 16384, 8
#: Magic, stream, number of the part in the stream, cloud, index and count in the cloud, checksum
#: of the cloud.
_HEAD = struct.Struct('<4sIQIHHI')
_MAGIC = b'PCP1'
#: Number of streams whose clouds are put together at once.
OPEN = 4


def split(data: bytes, stream: int, cloud: int, first: int) -> list[bytes]:
    """
    Split a coded cloud into parts of equal size.

    :param first: number of the first part; the numbers of a stream grow by one for each part.
    """
    most = min(LARGEST, max(LEAST, len(data) // MANY))
    count = -(-len(data) // most)
    size = -(-len(data) // count)
    checksum = zlib.crc32(data)
    return [_HEAD.pack(_MAGIC, stream, first + index, cloud, index, count, checksum)
            + data[index * size:(index + 1) * size] for index in range(count)]


@dataclasses.dataclass
class _Open:
    """A cloud of which parts are missing."""

    identity: tuple[int, int, int]
    parts: dict[int, bytes] = dataclasses.field(default_factory=dict)
    size: int = 0


class Assembler:
    """
    Put clouds together; of each stream the newest one.

    :param max_bytes: parts of more bytes are given up.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._clouds: dict[int, _Open] = {}  # by stream

    def add(self, part: bytes) -> tuple[Optional[tuple[int, int]], Optional[bytes]]:
        """Return what to acknowledge (stream, number), None if invalid, and a complete cloud."""
        if len(part) < _HEAD.size:
            return None, None
        magic, stream, number, cloud, index, count, checksum = _HEAD.unpack_from(part)
        if magic != _MAGIC or index >= count:
            return None, None
        identity = cloud, count, checksum
        if stream not in self._clouds or self._clouds[stream].identity != identity:
            self._clouds[stream] = _Open(identity)
            while len(self._clouds) > OPEN:
                del self._clouds[next(iter(self._clouds))]
        entry = self._clouds[stream]
        if index not in entry.parts:
            entry.parts[index] = part[_HEAD.size:]
            entry.size += len(part) - _HEAD.size
        if sum(each.size for each in self._clouds.values()) > self._max_bytes:
            self._clouds.clear()
        if len(entry.parts) < count:
            return (stream, number), None
        whole = b''.join(entry.parts[at] for at in range(count))
        self._clouds[stream] = _Open(identity)
        return (stream, number), whole if zlib.crc32(whole) == checksum else None
