# SPDX-License-Identifier: Apache-2.0
"""
Packets in pieces of which some may be lost: forward error correction for links that lose.

A packet of ten fragments is lost with any one of them: at 2 % loss that is every fifth. So while a
receiver reports losses, each packet is sent once more in pieces that fit into one datagram each,
with parities: the pieces in turn form groups, and a group's parity (its pieces' exclusive or)
replaces any one of them. Nothing is asked for twice, so a repair costs no round trip.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Optional
import zlib

import numpy
from numpy.typing import NDArray

#: Bytes of a piece, so that with all headers it stays below the VPN's 1420.
PIECE = 1100
#: Pieces that share a parity.
GROUP = 5
#: Packets that are put together at once; what is older is given up.
OPEN = 6
_HEADER = struct.Struct('>IIIHHH')
#: A piece's checksum: what is damaged counts as lost.
_SUM = struct.Struct('>I')


def pieces(stream: int, sequence: int, packet: bytes) -> list[bytes]:
    """Return a packet as pieces, parities last; any loss of one in a group can be repaired."""
    count = max(1, -(-len(packet) // PIECE))
    parities = -(-count // GROUP)
    block = numpy.zeros((count, PIECE), numpy.uint8)
    block.reshape(-1)[:len(packet)] = numpy.frombuffer(packet, numpy.uint8)
    out = []
    for index in range(count + parities):
        if index < count:
            # what the last piece lacks is zero, and needs not travel
            body = packet[index * PIECE:(index + 1) * PIECE]
        else:
            body = numpy.bitwise_xor.reduce(block[index - count::parities], axis=0).tobytes()
        head = _HEADER.pack(stream, sequence, len(packet), count, parities, index)
        out.append(_SUM.pack(zlib.crc32(head + body)) + head + body)
    return out


@dataclasses.dataclass
class _Packet:
    size: int
    count: int
    parities: int
    block: NDArray[numpy.uint8]
    have: set[int] = dataclasses.field(default_factory=set)
    done: bool = False


class Assembler:
    """Puts packets together from their pieces, in whatever order those come."""

    def __init__(self) -> None:
        self._packets: dict[tuple[int, int], _Packet] = {}

    def add(self, piece: bytes) -> Optional[bytes]:
        """Take a piece; return its packet if this was the one that was still missing."""
        start = _SUM.size + _HEADER.size
        if len(piece) < start or _SUM.unpack_from(piece)[0] != zlib.crc32(piece[_SUM.size:]):
            return None
        stream, sequence, size, count, parities, index = _HEADER.unpack_from(piece, _SUM.size)
        body = piece[start:]
        if not (0 < count <= 4096 and (count - 1) * PIECE < max(size, 1) <= count * PIECE
                and parities == -(-count // GROUP) and index < count + parities
                and len(body) <= PIECE):
            return None
        packet = self._packets.get((stream, sequence))
        if packet is None:
            packet = _Packet(size, count, parities,
                             numpy.zeros((count + parities, PIECE), numpy.uint8))
            self._packets[stream, sequence] = packet
            while len(self._packets) > OPEN:
                del self._packets[next(iter(self._packets))]
        if packet.done or (packet.size, packet.count) != (size, count):
            return None
        packet.block[index, :len(body)] = numpy.frombuffer(body, numpy.uint8)
        packet.have.add(index)
        if not self._repair(packet):
            return None
        packet.done = True
        whole = packet.block[:count].reshape(-1)[:size].tobytes()
        packet.block = packet.block[:0]
        return whole

    def _repair(self, packet: _Packet) -> bool:
        """Fill groups that miss one piece; return whether the packet is whole."""
        whole = True
        for parity in range(packet.parities):
            members = [*range(parity, packet.count, packet.parities), packet.count + parity]
            missing = [m for m in members if m not in packet.have]
            if not missing or missing == [packet.count + parity]:
                continue
            if len(missing) > 1:
                whole = False
                continue
            others = [m for m in members if m != missing[0]]
            packet.block[missing[0]] = numpy.bitwise_xor.reduce(packet.block[others], axis=0)
            packet.have.add(missing[0])
        return whole
